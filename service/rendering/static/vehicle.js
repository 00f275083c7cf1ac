// History of one vehicle's parameters, its newest window, and what is new about it.
"use strict";
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const base = `/vehicles/${encodeURIComponent(data.vehicle)}`;
  const at = (id) => document.getElementById(id);
  const utc = (seconds) => uPlot.tzDate(new Date(seconds * 1e3), "Etc/UTC");
  const style = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const COLOURS = ["--blue", "--alarm", "--good", "--warning", "--learning"];
  const BAND = 1.96;
  const LATEST = 4e9; // s: what the service takes for the end of a range
  let range = null; // [from, to] in s; null: all
  let newestSeconds = 0; // that are shown instead, up to the newest window whenever one comes; 0: none
  let plots = [];
  let request = 0;

  function span() {
    if (!newestSeconds || !data.last) return range;
    const end = data.last / 1e3 + data.hop;
    return [end - newestSeconds, end];
  }

  function bounded([from, to]) {
    const middle = (from + to) / 2;
    const half = Math.max((to - from) / 2, data.hop);
    return [Math.max(0, middle - half), Math.min(LATEST, middle + half)];
  }

  // what is shown is kept in the address, `#secondary_2r.damping&last=600`: for reloads, links and the way back
  const SELECTS = { overlay: "beside", scale: "as", under: "under" };
  const initial = Object.fromEntries(Object.keys(SELECTS).map((id) => [id, at(id)?.value]));

  function remember() {
    const found = new URLSearchParams();
    if (newestSeconds) found.set("last", newestSeconds);
    else if (range) {
      found.set("since", new Date(range[0] * 1e3).toISOString());
      found.set("until", new Date(range[1] * 1e3).toISOString());
    }
    for (const [id, name] of Object.entries(SELECTS)) if (at(id) && at(id).value !== initial[id]) found.set(name, at(id).value);
    const hash = `#${[encodeURIComponent(at("parameter").value), found].filter(String).join("&")}`;
    if (hash === location.hash) return;
    const same = hash.split("&")[0] === location.hash.split("&")[0]; // steps in time are no steps of the way back
    history[same ? "replaceState" : "pushState"](null, "", hash);
  }

  function recall() {
    const asked = new URLSearchParams(`parameter=${location.hash.slice(1)}`);
    const name = asked.get("parameter") || data.first;
    if (!data.parameters[name]) return;
    at("parameter").value = name;
    for (const [id, key] of Object.entries(SELECTS)) if (at(id)) {
      at(id).value = asked.get(key) ?? initial[id];
      if (at(id).selectedIndex < 0) at(id).value = initial[id];
    }
    newestSeconds = Math.max(0, Number(asked.get("last")) || 0);
    const ends = ["since", "until"].map((key) => Date.parse(asked.get(key)) / 1e3);
    range = ends.every(Number.isFinite) && ends[0] < ends[1] ? bounded(ends) : null;
  }

  function chosen() {
    const name = at("parameter").value;
    const twins = data.twins[name]?.[at("overlay").value] || [];
    return [name, ...twins].slice(0, 8);
  }

  function scaled(name, column) {
    const percent = at("scale").value === "percent";
    const reference = column.baseline ?? column.nominal;
    const value = (v) => (v === null ? null : percent ? 100 * (v / reference - 1) : v);
    return {
      mean: column.value.map(value),
      high: column.value.map((v, i) => (v === null ? null : value(v + BAND * column.std[i]))),
      low: column.value.map((v, i) => (v === null ? null : value(v - BAND * column.std[i]))),
      baseline: column.baseline === null ? null : value(column.baseline),
      nominal: value(column.nominal),
      unit: percent ? "%" : column.unit,
    };
  }

  // a hole in time is a hole in the line
  function withGaps(time, step, rows) {
    const xs = [];
    const out = rows.map(() => []);
    const longest = 3 * Math.max(step, data.hop);
    time.forEach((t, i) => {
      if (i && t - time[i - 1] > longest) {
        xs.push(time[i - 1] + longest / 2);
        out.forEach((row) => row.push(null));
      }
      xs.push(t);
      rows.forEach((row, r) => out[r].push(row[i]));
    });
    return [xs, ...out];
  }

  // an alarm may be of one parameter, or of all of a kind, as *.damping and primary_*.stiffness
  function covers(pattern, name) {
    const [head, tail] = pattern.split("*");
    return tail === undefined ? pattern === name : name.startsWith(head) && name.endsWith(tail);
  }

  function lines(u, levels) {
    const { ctx } = u;
    ctx.save();
    ctx.beginPath();
    ctx.rect(u.bbox.left, u.bbox.top, u.bbox.width, u.bbox.height);
    ctx.clip();
    for (const { y, dash } of levels) {
      if (y === null) continue;
      const py = u.valToPos(y, "y", true);
      ctx.strokeStyle = style("--soft");
      ctx.setLineDash(dash);
      ctx.beginPath();
      ctx.moveTo(u.bbox.left, py);
      ctx.lineTo(u.bbox.left + u.bbox.width, py);
      ctx.stroke();
    }
    const name = at("parameter").value;
    const moments = [
      ...data.alarms.filter((a) => a.parameter === null || covers(a.parameter, name))
        .map((a) => ({ time: a.onset, text: a.parameter ? a.severity : a.kind, colour: style("--alarm") })),
      ...data.marks.map((m) => ({ time: m.time, text: m.kind, colour: style("--good") })),
    ];
    ctx.font = `${11 * devicePixelRatio}px system-ui`;
    ctx.textAlign = "left";
    moments.forEach(({ time, text, colour }, i) => {
      const px = u.valToPos(Date.parse(time) / 1e3, "x", true);
      if (px < u.bbox.left || px > u.bbox.left + u.bbox.width) return;
      ctx.strokeStyle = ctx.fillStyle = colour;
      ctx.setLineDash([]);
      ctx.beginPath();
      ctx.moveTo(px, u.bbox.top);
      ctx.lineTo(px, u.bbox.top + u.bbox.height);
      ctx.stroke();
      const over = px + 4 + ctx.measureText(text).width > u.bbox.left + u.bbox.width; // it stands on the other side
      ctx.fillText(text, over ? px - 4 - ctx.measureText(text).width : px + 4, u.bbox.top + (12 + 13 * (i % 4)) * devicePixelRatio);
    });
    ctx.restore();
  }

  // how ticks are written that are so many s apart: slices of 2026-09-21T14:32:05.500Z for the first line, and for a
  // second one where that changes
  const TICKS = [[31536000, [0, 4]], [2419200, [0, 7]], [86400, [5, 10], [0, 4]], [60, [11, 16], [0, 10]], [1, [16, 19], [11, 16]], [0, [16, 23], [11, 16]]];
  const CHARACTER = 7; // px, of a label

  function dates(u, splits, axis, space, step) {
    const [, upper, lower] = TICKS.find(([seconds]) => step >= seconds);
    const times = splits.map((t) => new Date(t * 1e3).toISOString());
    if (!lower) return times.map((t) => t.slice(...upper));
    const whole = (t) => (lower[0] ? `${t.slice(0, 10)} ${t.slice(...lower)}` : t.slice(...lower));
    const changed = (i) => times[i].slice(0, lower[1]) !== times[i - 1].slice(0, lower[1]);
    const below = times.map((t, i) => (i && !changed(i) ? "" : i && t.slice(0, 10) === times[i - 1].slice(0, 10) ? t.slice(...lower) : whole(t)));
    const next = below.findIndex((text, i) => i && text);
    if (next > 0 && (2 * next * space) / CHARACTER < below[0].length + below[next].length + 2) { // they would overlap
      below[0] = "";
      below[next] = whole(times[next]);
    }
    return times.map((t, i) => t.slice(...upper) + (below[i] && `\n${below[i]}`));
  }

  const LABEL = 18; // px, of an axis's unit
  const axes = (clock = true, unit = "") => {
    const grid = { stroke: style("--line"), width: 1 };
    const across = { stroke: style("--soft"), grid, ticks: grid };
    const up = { stroke: style("--soft"), grid, ticks: grid, size: 70 };
    if (!clock) return [across, up];
    const numbers = at("scale").value === "percent" ? 54 : 70; // plots below each other begin at the same place
    const named = unit ? { size: numbers, label: unit, labelSize: LABEL } : { size: numbers + LABEL };
    return [{ ...across, values: dates }, { ...up, ...named }];
  };

  // indices of points that a line would hide: a ride of minutes is a pixel or two of a history of days
  const NARROW = 6; // px
  function lonely(u, index) {
    const [xs, ys] = [u.data[0], u.data[index]];
    const found = [];
    let run = [];
    for (let i = 0; i <= xs.length; i++) {
      if (i < xs.length && ys[i] !== null) {
        run.push(i);
        continue;
      }
      if (run.length && u.valToPos(xs[run.at(-1)], "x") - u.valToPos(xs[run[0]], "x") < NARROW) found.push(...run);
      run = [];
    }
    return found;
  }

  const hold = (answer) => Math.max(answer.resolution, data.hop); // s that a point stands for

  function shade(u, still, seconds) {
    const { ctx } = u;
    const right = u.bbox.left + u.bbox.width;
    ctx.save();
    ctx.fillStyle = style("--line");
    still.forEach((t) => {
      const [from, to] = [t, t + seconds].map((x) => Math.min(Math.max(u.valToPos(x, "x", true), u.bbox.left), right));
      ctx.fillRect(from, u.bbox.top, to - from, u.bbox.height);
    });
    ctx.restore();
  }

  // stood: times in ms of points without a window that told anything; the tracker's belief is no measurement there
  function draw(names, answer, stood) {
    plots.forEach((plot) => plot.destroy());
    const shown = names.map((name) => ({ name, ...scaled(name, answer.parameters[name]) }));
    const measured = (row) => row.map((v, i) => (stood.has(answer.time[i]) ? null : v));
    const rows = shown.flatMap((s) => [s.mean, s.high, s.low].map(measured));
    const still = answer.time.filter((t) => stood.has(t)).map((t) => t / 1e3);
    at("stood").hidden = !still.length;
    const time = answer.time.map((t) => t / 1e3);
    const columns = withGaps(time, answer.resolution, [...rows, answer.windows]);
    const width = at("plot").clientWidth;
    const sync = { key: "history" };
    const series = [{ label: "time", value: (_, v) => (v === null ? "–" : new Date(v * 1e3).toISOString().slice(0, 19).replace("T", " ")) }];
    const bands = [];
    shown.forEach((s, i) => {
      const colour = style(COLOURS[i % COLOURS.length]);
      const text = (_, v) => (v === null || v === undefined ? "–" : `${Number(v).toPrecision(4)} ${s.unit}`);
      series.push({ label: s.name, stroke: colour, width: 2, value: text, points: time.length < 60 ? {} : { show: true, size: NARROW, fill: colour, filter: lonely } });
      series.push({ label: "upper", stroke: "transparent", points: { show: false }, value: text });
      series.push({ label: "lower", stroke: "transparent", points: { show: false }, value: text });
      bands.push({ series: [3 * i + 2, 3 * i + 3], fill: i ? "transparent" : style("--band") });
    });
    const hooks = {
      drawClear: [(u) => shade(u, still, hold(answer))],
      draw: [(u) => lines(u, [{ y: shown[0].baseline, dash: [6, 4] }, { y: shown[0].nominal, dash: [2, 3] }])],
      setSelect: [(u) => {
        if (u.select.width < 5) return;
        show([u.posToVal(u.select.left, "x"), u.posToVal(u.select.left + u.select.width, "x")]);
      }],
    };
    const cursor = { sync, drag: { x: true, y: false, setScale: false } };
    const wanted = span();
    const scales = wanted ? { x: { min: wanted[0], max: wanted[1] } } : {};
    plots = [new uPlot({ width, height: 320, series, bands, hooks, cursor, scales, tzDate: utc, axes: axes(true, shown[0].unit) }, columns.slice(0, -1), at("plot"))];
    const lower = { label: "windows a point", stroke: style("--soft"), fill: style("--band"), paths: uPlot.paths.bars({ size: [1, 30] }) };
    plots.push(new uPlot({ width, height: 130, series: [series[0], lower], cursor, scales: { ...scales, y: { range: (_, low, most) => [0, Math.max(most, 1)] } }, tzDate: utc, axes: axes() }, [columns[0], columns.at(-1)], at("lower")));
    plots.forEach((plot) => plot.over.addEventListener("dblclick", () => show(null)));
    const step = answer.resolution ? `one point is ${answer.resolution} s` : "single windows";
    const nothing = wanted ? "no window in this range: “all” shows every one" : "no window yet";
    at("shown").textContent = time.length ? `${time.length} points, ${step}` : nothing;
    table(shown, answer);
  }

  // below: what the bodies carried, on the left, and the temperature (or the speed), on the right
  function drawRan(answer, first, last) {
    const known = Object.keys(answer.series);
    const names = known.filter((name) => name.endsWith(".load"));
    const other = ["temperature", "speed"].find((name) => known.includes(name));
    if (other) names.push(other);
    at("ran").hidden = !names.length;
    if (!names.length) return;
    const middle = (t) => Math.min(Math.max(t / 1e3 + answer.resolution / 2, first), last);
    const time = answer.time.map(middle);
    const columns = withGaps(time, answer.resolution, names.map((name) => answer.series[name].value));
    const sync = { key: "history" };
    const units = [...new Set(names.map((name) => answer.series[name].unit))];
    const written = (unit) => (unit === "degC" ? "°C" : unit);
    const series = names.map((name, i) => {
      const { unit } = answer.series[name];
      const value = (_, v) => (v === null || v === undefined ? "–" : `${Number(v).toPrecision(4)} ${written(unit)}`);
      const colour = style(COLOURS[i % COLOURS.length]);
      return { label: name, scale: unit, stroke: colour, width: 2, value, dash: i ? [6, 3] : [], points: { show: time.length < 60 } };
    });
    const [across] = axes();
    const beside = units.map((unit, i) => ({ ...axes(true, written(unit))[1], scale: unit, side: i ? 1 : 3, grid: { show: !i } }));
    const clock = { label: "time", value: (_, v) => (v === null ? "–" : new Date(v * 1e3).toISOString().slice(0, 16).replace("T", " ")) };
    const options = { width: at("plot").clientWidth, height: 170, series: [clock, ...series], axes: [across, ...beside], tzDate: utc };
    const cursor = { sync, drag: { x: false, y: false } };
    plots.push(new uPlot({ ...options, cursor, scales: { x: { min: first, max: last } } }, columns, at("ran")));
  }

  function table(shown, answer) {
    const made = document.createElement("table");
    const head = made.createTHead().insertRow();
    for (const text of ["Time (UTC)", ...shown.flatMap((s) => [`${s.name} [${s.unit}]`, "95 % band"])]) {
      const cell = document.createElement("th");
      cell.scope = "col";
      cell.textContent = text;
      head.append(cell);
    }
    const body = made.createTBody();
    for (let i = Math.max(0, answer.time.length - 20); i < answer.time.length; i++) {
      const row = body.insertRow();
      row.insertCell().textContent = new Date(answer.time[i]).toISOString().slice(0, 19).replace("T", " ");
      for (const s of shown) {
        row.insertCell().textContent = s.mean[i] === null ? "–" : s.mean[i].toPrecision(5);
        row.insertCell().textContent = s.mean[i] === null ? "–" : `${s.low[i].toPrecision(5)} … ${s.high[i].toPrecision(5)}`;
      }
    }
    at("table").replaceChildren(made);
  }

  // another range, or what else was chosen; seconds: up to the newest window
  function show(wanted = range, seconds = 0) {
    range = wanted && bounded(wanted);
    newestSeconds = seconds;
    remember();
    load();
  }

  function load() {
    const number = ++request;
    fetched(number).catch(() => { if (number === request) at("shown").textContent = "the service does not answer"; });
  }

  async function fetched(number) {
    const range = span();
    document.querySelectorAll("[data-range]").forEach((b) =>
      b.setAttribute("aria-pressed", String(Number(b.dataset.range) === newestSeconds && !(range && !newestSeconds))));
    const names = chosen();
    const query = new URLSearchParams({ format: "columns" });
    names.forEach((name) => query.append("parameter", name));
    if (at("under")) query.set("model", at("under").value);
    if (range) {
      query.set("since", Math.max(0, range[0]).toFixed(3));
      query.set("until", range[1].toFixed(3));
    }
    const asked = new URLSearchParams([...query].filter(([key]) => key === "since" || key === "until"));
    const [answer, ran] = await Promise.all([fetch(`${base}/history?${query}`), fetch(`${base}/circumstances?${asked}`)]);
    if (number !== request) return;
    if (answer.status === 422 && at("under")) { at("shown").textContent = "this model has no such parameter"; return; }
    if (!answer.ok) { at("shown").textContent = "the history could not be read"; return; }
    const found = await answer.json();
    asked.set("resolution", found.resolution);
    if (query.has("model")) asked.set("model", query.get("model"));
    const told = await fetch(`/pages${base}/standing?${asked}`);
    const stood = new Set(told.ok ? (await told.json()).time : []);
    if (number !== request) return;
    draw(names, found, stood);
    if (ran.ok && found.time.length) {
      const ends = range || [found.time[0] / 1e3, found.time.at(-1) / 1e3 + data.hop];
      drawRan(await ran.json(), ...ends);
    }
    document.querySelectorAll("a[data-element]").forEach((a) =>
      a.classList.toggle("current", at("parameter").value.startsWith(`${a.dataset.element}.`)));
  }

  function choose(name) {
    at("parameter").value = name;
    remember();
    load();
    at("history").scrollIntoView({ block: "start" });
  }

  // of an element the quantity that needs attention most
  function ofElement(element) {
    const names = Object.keys(data.parameters).filter((name) => name.startsWith(`${element}.`));
    const bad = names.filter((name) => data.alarms.some((a) => a.parameter === name && !a.recovered));
    return bad[0] || names[0];
  }

  document.addEventListener("click", (event) => {
    const link = event.target.closest("a[data-element], a[data-parameter], a[data-sensor]");
    if (link) {
      event.preventDefault();
      if (link.dataset.sensor) {
        at("sensor").value = link.dataset.sensor;
        if (at("sensor").selectedIndex < 0) at("sensor").selectedIndex = 0; // nothing came of it
        else newest();
        at("sensors").scrollIntoView();
        return;
      }
      const name = link.dataset.parameter || ofElement(link.dataset.element);
      if (name) choose(name);
      return;
    }
    const button = event.target.closest("button");
    if (!button) return;
    if (button.dataset.use) { useModel(button.dataset.use); return; }
    const [first, last] = span() || (plots[0]?.data[0].length ? [plots[0].data[0][0], plots[0].data[0].at(-1)] : []);
    if (button.dataset.range !== undefined) show(null, Number(button.dataset.range));
    else if (button.id === "fetchwindow") newest();
    else if (first === undefined) return; // nothing is shown that could be moved
    else if (button.dataset.move) {
      const by = Number(button.dataset.move) * (last - first);
      show([first + by, last + by]);
    } else if (button.dataset.zoom) {
      const middle = (first + last) / 2;
      const half = (Number(button.dataset.zoom) * (last - first)) / 2;
      show([middle - half, middle + half]);
    }
  });
  ["parameter", "overlay", "scale", "under"].forEach((id) => at(id)?.addEventListener("change", () => { remember(); load(); }));
  addEventListener("popstate", () => { recall(); load(); });

  function useModel(report) {
    at("usereport").value = report;
    at("usemodel").showModal();
  }

  let pair = [];
  async function newest() {
    at("windowstatus").textContent = "simulating …";
    const answer = await fetch(`${base}/window`).catch(() => null);
    const found = await answer?.json().catch(() => null);
    if (!answer?.ok || !found) { at("windowstatus").textContent = found?.detail || "the service does not answer"; return; }
    const sensor = found.sensors[at("sensor").value];
    if (!sensor) { at("windowstatus").textContent = "no sensor of this vehicle has been heard yet"; return; }
    at("windowstatus").textContent = `window of ${found.start.slice(0, 19).replace("T", " ")}, ${found.adequate ? "fits" : found.reason || "does not fit"}`;
    pair.forEach((plot) => plot.destroy());
    at("compared").replaceChildren();
    const time = sensor.simulated.map((_, i) => i / found.sample_rate);
    const options = (series) => {
      const box = document.createElement("div");
      at("compared").append(box);
      return [{ width: box.clientWidth, height: 230, series, axes: axes(false), scales: { x: { time: false } } }, box];
    };
    const line = (label, colour) => ({ label: `${label} [${sensor.unit}]`, stroke: style(colour), width: 1.5, points: { show: false } });
    const [one, left] = options([{ label: "s" }, line("measured", "--ink"), line("simulated", "--blue")]);
    pair = [new uPlot(one, [time, sensor.measured, sensor.simulated], left)];
    const [two, right] = options([{ label: "s" }, line("residual", "--alarm")]);
    pair.push(new uPlot(two, [time, sensor.residual], right));
  }
  at("sensor").addEventListener("change", newest);

  let waiting = false;
  async function redraw() {
    waiting = false;
    const answer = await fetch(location.href, { headers: { accept: "text/html" } });
    if (!answer.ok) return;
    const page = new DOMParser().parseFromString(await answer.text(), "text/html");
    for (const part of document.querySelectorAll("[data-live]")) {
      const fresh = page.getElementById(part.id);
      if (fresh && !part.contains(document.activeElement)) part.replaceChildren(...fresh.childNodes);
    }
    Object.assign(data, JSON.parse(page.getElementById("data").textContent));
    if (!document.querySelector("dialog[open]")) load();
    at("status").textContent = `Live; last change ${new Date().toISOString().slice(11, 19)} UTC`;
  }
  const news = new EventSource(`/events?vehicle=${encodeURIComponent(data.vehicle)}`);
  news.addEventListener("vehicle", () => {
    if (waiting) return;
    waiting = true;
    setTimeout(() => redraw().catch(() => {}), 2000);
  });
  news.onopen = () => { at("status").textContent = "Live"; };
  news.onerror = () => { at("status").textContent = "Not connected; trying again"; };
  window.addEventListener("resize", () => plots.forEach((plot) => plot.setSize({ width: at("plot").clientWidth, height: plot.height })));
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", load);
  if (data.first) at("parameter").value = data.first;
  recall();
  if (location.hash.startsWith("#use=")) useModel(location.hash.slice(5));
  load();
})();
