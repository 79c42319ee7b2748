"use strict";
const $ = (id) => document.getElementById(id);
const fixed = (value, digits) => (value === null || value === undefined ? "–" : value.toFixed(digits));
const map = new MapCanvas($("map"));
let token = sessionStorage.getItem("token") ?? "";
let scales = [];

// Everything from the system is inserted as text, never as markup.
function cell(row, text, className) {
  const td = row.insertCell();
  td.textContent = text;
  if (className) td.className = className;
  return td;
}

function stateClass(state) {
  return { active: "good", drained: "good", silent: "bad", failed: "bad" }[state] ?? "warn"; // silent: no health message
}

function showNodes(nodes) {
  const body = document.createElement("tbody");
  for (const n of nodes) {
    const row = body.insertRow();
    row.dataset.node = n.name;
    cell(row, n.name);
    const state = n.state === "silent" ? `silent ${n.silent_s} s` : n.state;
    cell(row, state + (n.starts > 1 ? ` (start ${n.starts})` : ""), stateClass(n.state));
    for (const key of ["in_hz", "out_hz", "step_ms", "p95_ms", "age_ms"]) cell(row, fixed(n[key], 1));
    cell(row, n.dropped, n.dropped ? "warn" : "");
    cell(row, n.lost, n.lost ? "bad" : "");
    cell(row, n.bad, n.bad ? "bad" : "");
    cell(row, n.rss_mb);
    cell(row, n.cpu_percent);
    if (n.detail) {
      row.className = "has-detail";
      cell(body.insertRow(), n.detail, n.state === "failed" ? "detail bad" : "detail").colSpan = 12;
    }
  }
  $("nodes").tBodies[0].replaceWith(body);
}

function showLinks(links) {
  const body = document.createElement("tbody");
  for (const l of links) {
    const row = body.insertRow();
    row.dataset.topic = l.topic;
    cell(row, l.topic);
    cell(row, l.from);
    cell(row, fixed(l.hz, 1), l.nominal_hz && l.hz < 0.5 * l.nominal_hz ? "warn" : "");
    cell(row, l.nominal_hz || "event");
    cell(row, fixed(l.kb_s, 1));
    const to = cell(row, "");
    for (const t of l.to) {
      const span = document.createElement("span");
      span.textContent = `${t.node} (${fixed(t.age_ms, 1)}, ${t.dropped}, ${t.lost})  `;
      if (t.lost) span.className = "bad";
      to.append(span);
    }
  }
  $("links").tBodies[0].replaceWith(body);
}

function showWords(words) {
  const lines = [];
  for (const [subject, w] of Object.entries(words)) {
    let text = w.status + (w.detail ? ` (${w.detail})` : "");
    if (w.metric === false) text += ", scale unknown (not metric)";
    if (subject === "mapping") text += `; ${w.keyframes} keyframes, ${w.gaussians} Gaussians, ${fixed(w.psnr_db, 1)} dB, depth error ${fixed(w.depth_error_m, 3)} m`;
    if (subject === "fusion") text += `; ${fixed(100 * w.inlier_share, 0)} % of the lidar-depth pairs are inliers, residual ${fixed(w.residual_m, 3)} m`;
    lines.push([subject, `${text}, ${fixed(w.age_s, 0)} s ago`, w.status === "ok" ? "good" : "bad"]);
  }
  $("words").replaceChildren(...lines.flatMap(([subject, text, className]) => {
    const dt = document.createElement("dt"), dd = document.createElement("dd");
    dt.textContent = subject; dd.textContent = text; dd.className = className;
    return [dt, dd];
  }));
  const f = words.fusion;
  if (f) $("scale-text").textContent = f.scale === null ? "none" : `${fixed(f.scale, 3)} ± ${fixed(f.scale_sigma, 3)}`;
}

function showSummary(status) {
  const stopped = status.nodes.filter((n) => n.state === "silent" || n.state === "failed").length;
  const parts = [
    [`${status.nodes.length - stopped} of ${status.nodes.length} nodes running`, stopped ? "bad" : "good"],
    [`${status.nodes.reduce((sum, n) => sum + n.lost, 0)} messages lost`, status.nodes.some((n) => n.lost) ? "bad" : "good"],
    [`${status.nodes.reduce((sum, n) => sum + n.late, 0)} late`, "good"],
    [`pages open: ${status.page.viewers}`, ""],
  ];
  $("summary").replaceChildren(...parts.map(([text, className]) => {
    const li = document.createElement("li");
    li.textContent = text; li.className = className;
    return li;
  }));
}

function showLog(log) {
  $("log").replaceChildren(...log.slice().reverse().map((line) => {
    const li = document.createElement("li");
    li.textContent = `${new Date(line.at * 1000).toLocaleTimeString()}  ${line.text}`;
    return li;
  }));
}

function offerNodes(names) {
  const select = $("node");
  if ([...select.options].map((o) => o.value).join() === names.join()) return; // do not close an open list
  const chosen = select.value;
  select.replaceChildren(...names.map((name) => new Option(name, name, false, name === chosen)));
}

function showAlerts(alerts) {
  const lines = alerts.map((a) => `${a.alert.replaceAll("_", " ")}, since ${new Date(a.since).toLocaleTimeString()}: ${a.text}`);
  $("alerts-section").hidden = !lines.length;
  if ([...$("alerts").children].map((li) => li.textContent).join("\n") === lines.join("\n")) return; // a screen reader would repeat it
  $("alerts").replaceChildren(...lines.map((line) => {
    const li = document.createElement("li");
    li.textContent = line; li.className = "bad";
    return li;
  }));
}

function showRobotName(page) {
  const inFleet = location.pathname.includes("/robots/");
  $("fleet").hidden = page.robots < 2;
  $("fleet").setAttribute("href", inFleet ? "../../fleet" : "fleet");
  document.title = page.robots < 2 ? "BeamSplat" : `BeamSplat: ${page.robot}`;
  document.querySelector("h1").textContent = document.title;
}

function showStatus(status) {
  showAlerts(status.alerts);
  showRobotName(status.page);
  showNodes(status.nodes);
  showLinks(status.links);
  showWords(status.words);
  showSummary(status);
  showLog(status.log);
  for (const [name, p] of Object.entries(status.pictures)) {
    const small = document.querySelector(`[data-picture="${name}"] small`);
    if (small) small.textContent = p.fault || (p.age_s > 3 ? `${fixed(p.age_s, 0)} s old` : "");
    small?.closest("figure").classList.toggle("stale", p.age_s > 10);
  }
  $("commands").hidden = !status.page.commands;
  offerNodes(status.nodes.map((n) => n.name));
}

// Load one image of each kind at a time: a slow connection skips images and never queues them.
const loading = new Map();
function fetchPicture(p) {
  if (loading.has(p.name)) { loading.set(p.name, p); return; }
  loading.set(p.name, null);
  const done = () => { const next = loading.get(p.name); loading.delete(p.name); if (next) fetchPicture(next); };
  const url = `picture/${p.name}?${p.number}`;
  if (p.name === "map") {
    const image = new Image();
    image.onload = () => { map.grid = { image, ...p }; map.draw(); done(); };
    image.onerror = done;
    image.src = url;
  } else {
    const img = document.querySelector(`[data-picture="${p.name}"] img`);
    img.onload = () => { img.hidden = false; img.dataset.number = p.number; done(); };
    img.onerror = done;
    img.src = url;
  }
}

function showRobot(robot) {
  map.robot = robot;
  $("pose").textContent = robot ? `${fixed(robot.x_m, 2)} m, ${fixed(robot.y_m, 2)} m, ${fixed((robot.yaw_rad * 180) / Math.PI, 0)}° by ${robot.source}` : "";
  map.draw();
}

// The tabs of the map: the flat one, and the 3D viewer, whose code and data are loaded when it is chosen.
let viewer = null;
async function openTab(three) {
  for (const [tab, on] of [["tab-flat", !three], ["tab-3d", three]]) {
    $(tab).setAttribute("aria-selected", String(on));
    $(tab).tabIndex = on ? 0 : -1;
  }
  $("flat").hidden = three;
  $("map3d").hidden = !three;
  $("map3d-fault").textContent = "";
  history.replaceState(null, "", three ? "#3d" : location.pathname);
  if (!three) { viewer?.close(); viewer = null; map.draw(); return; }
  try { // no bundle, or no WebGL 2
    const { openViewer } = await import("./viewer/viewer.js").catch(() => { throw new Error("it was not built: run make web on the robot"); });
    if (!$("map3d").hidden) viewer ??= openViewer($("map3d"), { base: "", saved: false, embedded: null });
  } catch (error) {
    await openTab(false);
    $("map3d-fault").textContent = `The 3D view cannot be shown: ${error.message}.`;
  }
}
for (const [tab, three] of [["tab-flat", false], ["tab-3d", true]]) {
  $(tab).addEventListener("click", () => openTab(three));
  $(tab).addEventListener("keydown", (e) => { // tabs are changed with the arrows
    if (e.key !== "ArrowLeft" && e.key !== "ArrowRight") return;
    $(three ? "tab-flat" : "tab-3d").focus();
    openTab(!three);
  });
}
if (location.hash === "#3d") openTab(true);

function drawScales() {
  const c = $("scale"), ratio = window.devicePixelRatio || 1, w = c.clientWidth, h = c.clientHeight;
  c.width = w * ratio; c.height = h * ratio;
  const g = c.getContext("2d");
  g.scale(ratio, ratio);
  if (!scales.length) return;
  const low = Math.min(...scales.map(([, v, s]) => v - (s ?? 0))), high = Math.max(...scales.map(([, v, s]) => v + (s ?? 0)));
  const margin = Math.max(0.1 * (high - low), 0.01 * Math.abs(high), 1e-6);
  const y = (v) => h - 4 - ((v - low + margin) / (high - low + 2 * margin)) * (h - 8), x = (age) => w - 46 - (age / 120) * (w - 50);
  const style = getComputedStyle(c);
  g.fillStyle = style.color;
  g.font = "11px system-ui, sans-serif";
  g.fillText(high.toPrecision(4), w - 42, 12);
  g.fillText(low.toPrecision(4), w - 42, h - 4);
  g.strokeStyle = g.fillStyle = style.getPropertyValue("--path");
  for (const [age, value, sigma] of scales) {
    g.fillRect(x(age) - 1.5, y(value) - 1.5, 3, 3);
    if (sigma !== null) { g.beginPath(); g.moveTo(x(age), y(value - sigma)); g.lineTo(x(age), y(value + sigma)); g.stroke(); }
  }
}

async function command(action, node, parameters = {}) {
  const reply = await fetch("command", {
    method: "POST",
    headers: { Authorization: `Bearer ${token}`, "Content-Type": "application/json" },
    body: JSON.stringify({ action, node, parameters }),
  });
  const answer = await reply.json();
  if (action === "params" && reply.ok) return JSON.parse(answer.text);
  $("answer").textContent = answer.text ?? answer.error;
  $("answer").className = reply.ok ? "good" : "bad";
  if (reply.status === 401) mayCommand(false);
  return reply.ok;
}

function mayCommand(may) {
  $("orders").hidden = !may;
  $("swap").hidden = true;
  $("login").hidden = may;
  if (!may) sessionStorage.removeItem("token");
}

const failed = (error) => { $("answer").textContent = String(error); $("answer").className = "bad"; return false; };
$("login").addEventListener("submit", async (e) => {
  e.preventDefault();
  token = $("token").value;
  const right = await command("check", "").catch(failed);
  if (right) { sessionStorage.setItem("token", token); $("token").value = ""; }
  mayCommand(right);
});
$("orders").addEventListener("submit", (e) => {
  e.preventDefault();
  const node = $("node").value;
  if (confirm(`Restart ${node}?`)) command("restart", node).catch(failed);
});
// The options of a node as fields; changed ones are sent to the successor, in the notation of a deployment (TOML).
let shown = { node: "", values: {} };
$("options").addEventListener("click", async () => {
  const node = $("node").value;
  const options = await command("params", node).catch(failed);
  if (!options) return;
  shown = { node, values: Object.fromEntries(Object.entries(options).map(([k, v]) => [k, v === null ? "" : JSON.stringify(v)])) };
  $("fields").replaceChildren(...Object.entries(shown.values).flatMap(([name, value]) => {
    const label = document.createElement("label"), input = document.createElement("input");
    label.textContent = name;
    label.htmlFor = input.id = `option-${name}`;
    input.name = name;
    input.value = value;
    return [label, input];
  }));
  $("swap").hidden = false;
});
$("swap").addEventListener("submit", (e) => {
  e.preventDefault();
  const changed = [...$("fields").querySelectorAll("input")].filter((i) => i.value !== shown.values[i.name]).map((i) => [i.name, i.value]);
  const said = changed.map(([name, value]) => `${name} = ${value}`).join(", ");
  if (!said) { $("answer").textContent = "no option was changed"; return; }
  if (!confirm(`Swap ${shown.node}: ${said}?`)) return;
  $("answer").textContent = "the successor is starting ...";
  command($("cold").checked ? "cold swap" : "swap", shown.node, Object.fromEntries(changed)).catch(failed);
  $("swap").hidden = true;
});
$("follow").addEventListener("change", (e) => { map.follow = e.target.checked; map.draw(); });
window.addEventListener("resize", drawScales);
if (token) mayCommand(true);

const connection = (text, className) => Object.assign($("connection"), { textContent: text, className });
const events = new EventSource("events");
const on = (kind, take) => events.addEventListener(kind, (e) => take(JSON.parse(e.data)));
events.onopen = () => connection("connected", "good");
events.onerror = () => connection("not connected", "bad"); // the browser reconnects by itself
on("status", showStatus);
on("scale", (data) => { scales = data; drawScales(); });
on("path", (data) => { map.path = data; map.draw(); });
on("robot", showRobot);
on("picture", fetchPicture);
