// The interactive description of the API, from this service's own files.
"use strict";
const dark = matchMedia("(prefers-color-scheme: dark)");
const follow = () => document.documentElement.classList.toggle("dark-mode", dark.matches); // Swagger UI's own dark colours
dark.addEventListener("change", follow);
follow();

// What Swagger UI leaves unnamed for who hears the page, or walks it by keys
const swagger = document.getElementById("swagger");
const named = {
  "h1.title": () => ({ "aria-level": "2" }), // below the page's own
  "table.responses-table": (e) => ({ "aria-label": `Answers of ${operationOf(e)}` }),
  "select:not([aria-label])": (e) => ({ "aria-label": nameOf(e) }),
  ".opblock-tag .expand-operation": (e) => ({ "aria-label": `Operations of ${e.closest(".opblock-tag").dataset.tag}` }),
  "textarea:not([aria-label])": (e) => ({ "aria-label": nameOf(e) }),
  "input:not([aria-label])": (e) => ({ "aria-label": nameOf(e) }),
  "pre:not([tabindex])": () => ({ tabindex: "0" }),
  ".opblock-summary-control a[href]": (e) => (e.removeAttribute("href"), {}), // a link inside a button
};
const operationOf = (e) => e.closest(".opblock")?.querySelector(".opblock-summary-path")?.textContent || "the operation";
const nameOf = (e) =>
  e.closest("tr")?.querySelector(".parameter__name")?.firstChild?.textContent ||
  e.labels?.[0]?.textContent ||
  `${e.tagName === "SELECT" ? "choice" : "text"} of ${operationOf(e)}`;
function name() {
  for (const [selector, attributes] of Object.entries(named))
    for (const e of swagger.querySelectorAll(selector))
      for (const [key, value] of Object.entries(attributes(e)))
        if (e.getAttribute(key) !== value) e.setAttribute(key, value);
}
new MutationObserver(name).observe(swagger, { childList: true, subtree: true });

// The page has a main part already: the one of Swagger UI is made a group
const oneMain = ({ React }) => {
  const create = React.createElement;
  React.createElement = (type, props, ...children) =>
    type === "main" ? create("div", { ...props, role: "group", "aria-label": "Operations" }, ...children) : create(type, props, ...children);
  return {};
};

SwaggerUIBundle({
  plugins: [oneMain],
  url: "/openapi.json",
  dom_id: "#swagger",
  docExpansion: "list",
  defaultModelsExpandDepth: 0,
  validatorUrl: null,
  syntaxHighlight: { activated: false }, // its colours are too faint
});
