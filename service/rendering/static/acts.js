// Buttons and forms that change something: JSON to the API, errors told where they happened.
"use strict";
const acts = (() => {
  const key = () => (crypto.randomUUID ? crypto.randomUUID() : String(Math.random()).slice(2) + Date.now());
  const csrf = () => document.querySelector('meta[name="csrf"]')?.content;

  const ask = (url, how) => fetch(url, how).catch(() => {  // what browsers say of it, "Failed to fetch", helps nobody
    throw new Error("The service does not answer. Try again when it is back.");
  });

  async function send(method, url, body) {
    const headers = { "content-type": "application/json", "idempotency-key": key() };
    if (csrf()) headers["x-csrf-token"] = csrf();
    const answer = await ask(url, { method, headers, body: body === undefined ? undefined : JSON.stringify(body) });
    const found = answer.status === 204 ? {} : await answer.json().catch(() => ({}));
    if (!answer.ok) throw new Error(found.detail || answer.statusText);
    return found;
  }

  async function follow(job, show) {
    for (;;) {
      const answer = await ask(`/jobs/${job}`);
      const now = await answer.json().catch(() => ({}));
      if (!answer.ok) throw new Error(now.detail || answer.statusText);
      show(now);
      if (now.state === "done" || now.state === "failed") return now;
      await new Promise((wait) => setTimeout(wait, 1000));
    }
  }

  function told(now) {
    if (now.state === "failed") return `failed: ${now.error}`;
    if (now.state === "done") return "done";
    return now.progress > 0 ? `${now.state} ${Math.round(100 * now.progress)} %` : now.state; // how long a recording is shows at its end
  }

  const outcome = () => document.getElementById("outcome");

  document.addEventListener("click", async (event) => {
    const button = event.target.closest("button");
    if (!button) return;
    if (button.dataset.dialog) document.getElementById(button.dataset.dialog).showModal();
    if (button.hasAttribute("data-close")) button.closest("dialog").close();
    if (button.dataset.post) {
      button.disabled = true;
      try {
        const found = await send(button.dataset.method || "POST", button.dataset.post, JSON.parse(button.dataset.body || "{}"));
        if (button.hasAttribute("data-follow")) {
          const now = await follow(found.id, (at) => { outcome().textContent = `${at.kind} ${told(at)}`; });
          if (now.result?.report) {
            const link = document.createElement("a");
            link.href = `/reports/${now.result.report}/page`;
            link.textContent = ` report: ${now.result.verdict.replaceAll("_", " ")}`;
            outcome().append(link);
          }
        } else if (document.dispatchEvent(new CustomEvent("acted", { cancelable: true }))) location.reload();
      } catch (error) {
        if (outcome()) outcome().textContent = error.message;
      }
      button.disabled = false;
    }
  });

  document.addEventListener("submit", async (event) => {
    const form = event.target.closest("form[data-action]");
    if (!form) return;
    event.preventDefault();
    const body = {};
    for (const [name, value] of new FormData(form)) {
      if (name === "which" || name === "parameters" || name === "confirm") continue;
      if (name !== "time") body[name] = value;
      else if (value) body.time = `${value}Z`;
    }
    const which = form.elements.which?.value;
    if (which === "some") body.parameters = [...form.elements.parameters.selectedOptions].map((o) => o.value);
    if (which === "none") body.parameters = [];
    if (which === "some" && !body.parameters.length) {
      form.querySelector("[role=alert]").textContent = "Choose at least one parameter, or “of none”.";
      return;
    }
    let url = form.dataset.action;
    if (form.elements.confirm) url += `?confirm=${encodeURIComponent(form.elements.confirm.value)}`;
    const method = form.dataset.method || "POST";
    try {
      await send(method, url, method === "DELETE" ? undefined : body);
      if (form.dataset.after) location.href = form.dataset.after;
      else location.reload();
    } catch (error) {
      form.querySelector("[role=alert]").textContent = error.message;
    }
  });

  document.addEventListener("change", ({ target }) => { // who chooses some means these
    if (target.name === "parameters" && target.form?.elements.which) target.form.elements.which.value = "some";
  });

  return { send, follow, told, csrf, key };
})();
