// Follows the fleet: news redraw the list in place, whatever is searched for.
"use strict";
(() => {
  const list = document.getElementById("list");
  const status = document.getElementById("status");
  let waiting = false;
  async function redraw() {
    waiting = false;
    const answer = await fetch(location.href, { headers: { accept: "text/html" } });
    if (!answer.ok) return;
    const page = new DOMParser().parseFromString(await answer.text(), "text/html");
    const focused = document.activeElement && document.activeElement.id;
    list.replaceChildren(...page.getElementById("list").childNodes);
    if (focused && document.getElementById(focused)) document.getElementById(focused).focus();
    status.textContent = `Live; last change ${new Date().toISOString().slice(11, 19)} UTC`;
  }
  function later() {
    if (waiting) return;
    waiting = true;
    setTimeout(() => redraw().catch(() => {}), 1500);
  }
  const news = new EventSource("/events");
  news.addEventListener("vehicle", later);
  news.onopen = () => { status.textContent = "Live"; };
  news.onerror = () => { status.textContent = "Not connected; trying again"; };
})();
