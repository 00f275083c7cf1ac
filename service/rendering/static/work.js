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
    const focused = document.activeElement?.id;
    document.getElementById("jobs").replaceWith(page.getElementById("jobs"));
    if (focused) document.getElementById(focused)?.focus();
  };
  document.addEventListener("acted", (event) => { // a reload would break off a file that is being sent
    event.preventDefault();
    listJobs().catch(() => {});
  });
  // jobs that wait or run, and can be cancelled, show how far they are
  setInterval(() => { if (document.querySelector("#jobs [id^=cancel-]")) listJobs().catch(() => {}); }, 3000);
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
    const stop = document.getElementById("stop");
    stop.hidden = false;
    stop.onclick = () => request.abort();
    request.onabort = () => { told.textContent = "stopped: nothing of the file is kept"; bar.hidden = true; };
    request.onloadend = () => { stop.hidden = true; };
    request.upload.onprogress = (at) => { bar.hidden = false; bar.max = at.total; bar.value = at.loaded; };
    const followed = async () => {
      let answer = {};
      try { answer = JSON.parse(request.responseText); } catch { /* of a proxy, not of the service */ }
      if (request.status !== 202) {
        told.textContent = answer.detail || `refused (${request.status})`;
        bar.hidden = true;
        return;
      }
      await listJobs();
      const now = await acts.follow(answer.id, (job) => {
        told.textContent = `${job.kind} ${acts.told(job)}`;
        bar.max = 1;
        if (job.progress > 0) bar.value = job.progress;
        else bar.removeAttribute("value"); // it is not known how far it is
      });
      if (now.state === "done") setTimeout(() => location.reload(), 1200);
      else await listJobs();
    };
    request.onload = () => followed().catch((error) => { told.textContent = error.message; });
    request.onerror = () => { told.textContent = "the upload was interrupted"; };
    request.send(body);
  });
})();
