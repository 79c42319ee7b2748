"use strict";
// The robots that this page knows: one card each, from robots (JSON), every two seconds.
const $ = (id) => document.getElementById(id);
const EVERY_MS = 2000, LATE_S = 5;
const cards = new Map(); // name -> its elements: they stay, so that the focus and the images stay

// Everything from the system is inserted as text, never as markup.
function element(tag, text = "", className = "") {
  const made = document.createElement(tag);
  made.textContent = text;
  if (className) made.className = className;
  return made;
}

function age(seconds) {
  if (seconds < 100) return `${seconds.toFixed(0)} s`;
  return seconds < 6000 ? `${(seconds / 60).toFixed(0)} min` : `${(seconds / 3600).toFixed(0)} h`;
}

function number(value) { return value === null ? "–" : value.toLocaleString("en"); }

function newCard({ name, own }) {
  const item = element("li"), link = element("a", name), list = element("dl");
  const image = element("img");
  item.dataset.robot = name;
  link.href = `robots/${encodeURIComponent(name)}/`;
  image.alt = `Map of ${name}`;
  image.hidden = true;
  item.append(element("h3"), image, list);
  item.firstChild.append(link, own ? " (this page)" : "");
  return { item, image, list, shown: 0 };
}

function facts(robot) {
  const pose = robot.localization === "none" ? "–" : robot.localization || "no pose yet";
  const poseClass = { "ok": "good", "–": "" }[pose] ?? "warn";
  const link = { up: ["up", "good"], down: ["down", "bad"], none: ["no uplink", ""] }[robot.link];
  return [
    ["last message", `${age(robot.age_s)} ago`, robot.age_s > LATE_S ? "bad" : "good"],
    ["nodes", `${robot.running} of ${robot.nodes} running`, robot.running < robot.nodes ? "bad" : "good"],
    ["pose", pose, poseClass],
    ["link", ...link],
    ["map", `${number(robot.keyframes)} keyframes, ${number(robot.gaussians)} Gaussians`, ""],
    ["outbox", robot.outbox === null ? "–" : `${number(robot.outbox)} keyframes wait`, ""],
    ["alerts", robot.alerts.length ? robot.alerts.map((a) => a.alert.replaceAll("_", " ")).join(", ") : "none", robot.alerts.length ? "bad" : "good"],
  ];
}

function fill(card, robot) {
  card.item.className = robot.age_s > LATE_S ? "stale" : "";
  card.list.replaceChildren(...facts(robot).flatMap(([name, text, className]) => [element("dt", name), element("dd", text, className)]));
  if (robot.map && robot.map !== card.shown) {
    card.shown = robot.map;
    card.image.onload = () => { card.image.hidden = false; };
    card.image.src = `robots/${encodeURIComponent(robot.name)}/picture/map?${robot.map}`;
  }
}

function show(robots) {
  const names = new Set(robots.map((r) => r.name));
  for (const [name, card] of cards) if (!names.has(name)) { card.item.remove(); cards.delete(name); }
  robots.forEach((robot, i) => {
    if (!cards.has(robot.name)) cards.set(robot.name, newCard(robot));
    const card = cards.get(robot.name);
    if ($("robots").children[i] !== card.item) $("robots").insertBefore(card.item, $("robots").children[i] ?? null);
    fill(card, robot);
  });
  const alerts = robots.flatMap((r) => r.alerts);
  const lines = alerts.map((a) => `${a.robot}: ${a.alert.replaceAll("_", " ")}, since ${new Date(a.since).toLocaleString()}: ${a.text}`);
  const before = [...$("alerts").children].map((li) => li.textContent);
  if (!before.length || before.join("\n") !== (lines.length ? lines : ["none"]).join("\n")) { // else a screen reader repeats it
    $("alerts").replaceChildren(...(lines.length ? lines.map((l) => element("li", l, "bad")) : [element("li", "none", "good")]));
  }
  const heard = robots.filter((r) => r.age_s <= LATE_S).length;
  $("summary").replaceChildren(element("li", `${heard} of ${robots.length} robots heard`, heard < robots.length ? "bad" : "good"));
}

function connection(text, className) {
  if ($("connection").textContent === text) return;
  $("connection").textContent = text;
  $("connection").className = className;
}

async function refresh() {
  try {
    const reply = await fetch("robots", { cache: "no-store" });
    if (!reply.ok) throw new Error(reply.statusText);
    show((await reply.json()).robots);
    connection("connected", "good");
  } catch {
    connection("not connected", "bad");
  }
  setTimeout(refresh, EVERY_MS);
}
refresh();
