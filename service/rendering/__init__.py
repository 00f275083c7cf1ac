"""Pages as HTML and SVG: templates, static files, drawings; no HTTP."""
