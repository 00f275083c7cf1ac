// Uploads with their progress, then the job's.
"use strict";
(() => {
  const form = document.getElementById("upload");
  const bar = document.getElementById("sent");
  const told = document.getElementById("outcome");
  const listJobs = async () => {
    const answer = await fetch(location.pathname);
    if (!answer.ok) return;
    const page = new DOMParser().parseFromString(await answer.text(), "text/html");
    document.getElementById("jobs").replaceWith(page.getElementById("jobs"));
  };
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    const body = new FormData();
    const file = form.elements.file.files[0];
    if (!file) return;
    if (form.elements.vehicle.value.trim()) body.append("vehicle", form.elements.vehicle.value.trim());
    if (form.elements.start.value) body.append("start", `${form.elements.start.value}Z`);
    body.append("file", file);
    const request = new XMLHttpRequest();
    request.open("POST", form.elements.what.value);
    request.setRequestHeader("Idempotency-Key", acts.key());
    if (acts.csrf()) request.setRequestHeader("X-CSRF-Token", acts.csrf());
    request.upload.onprogress = (at) => { bar.hidden = false; bar.max = at.total; bar.value = at.loaded; };
    request.onload = async () => {
      const answer = JSON.parse(request.responseText || "{}");
      if (request.status !== 202) { told.textContent = answer.detail || `refused (${request.status})`; return; }
      listJobs();
      const now = await acts.follow(answer.id, (job) => {
        told.textContent = `${job.kind} ${acts.told(job)}`;
        bar.max = 1;
        bar.value = job.progress;
      });
      if (now.state === "done") setTimeout(() => location.reload(), 1200);
      else listJobs();
    };
    request.onerror = () => { told.textContent = "the upload was interrupted"; };
    request.send(body);
  });
})();
