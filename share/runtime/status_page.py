"""The status page: it fetches /snapshot.json three times a second, /plan.json once, and shows them.

Self-contained, for machines without a 3D view and for phones."""

from __future__ import annotations

import json

from share.colours import AGENT_COLOURS, hex_colour

# Values from outside, such as names, are set as text, never as HTML.
_TEMPLATE = """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>SHARE edge</title>
<style>
:root { color-scheme: light dark; --line: #8884; --dim: #888; --bad: #d22; --good: #293 }
body { font: 15px/1.45 system-ui, sans-serif; margin: 0 auto; max-width: 84rem; padding: 1rem }
header { display: flex; flex-wrap: wrap; align-items: baseline; gap: .2rem 1rem }
h1 { font-size: 1.25rem; margin: 0 }
h2 { font-size: 1rem; margin: 1.4rem 0 .3rem }
summary { cursor: pointer }
summary h2 { display: inline-block }
small { color: var(--dim); font-weight: 400 }
header span, td.none { color: var(--dim) }
a { color: inherit }
td i { display: inline-block; width: .7em; height: .7em; margin-right: .4em; flex: none }
#mark { font-weight: 600; color: var(--good) }
.bad, #mark.bad { color: var(--bad) }
#fingerprint { color: var(--dim); overflow-wrap: anywhere }
#code { font-size: 1.4em; letter-spacing: .1em }
.trouble { margin: .5rem 0 0; padding-left: 1.2rem; color: var(--bad); overflow-wrap: anywhere }
.wide { overflow-x: auto }
table { border-collapse: collapse; font-variant-numeric: tabular-nums }
th, td { padding: .25rem .75rem .25rem 0; text-align: right; white-space: nowrap }
th { color: var(--dim); font-weight: 500; border-bottom: 1px solid var(--line) }
td { border-bottom: 1px solid var(--line) }
.words th:nth-child(-n+5), .words td:nth-child(-n+5), th:first-child, td:first-child { text-align: left }
td { max-width: 11rem; overflow: hidden; text-overflow: ellipsis }
td:first-child { max-width: 14rem }
#maps th:last-child, #maps td:last-child { text-align: left; white-space: normal }
#consistency td { text-align: left; vertical-align: top }
#consistency th { text-align: left }
#consistency td:nth-child(3) { white-space: normal; min-width: 12rem; overflow-wrap: anywhere }
tr.gone { color: var(--dim) }
#agents td:nth-child(4) { white-space: normal; min-width: 9rem; max-width: 18rem; overflow-wrap: anywhere }
.stale { opacity: .45 }
.plan { display: flex; flex-wrap: wrap; gap: 1rem }
.plan figure { margin: 0; flex: 1 1 20rem; min-width: 0; max-width: 36rem }
.plan figcaption { color: var(--dim); overflow-wrap: anywhere }
.plan svg { width: 100%; height: auto; max-height: 22rem; border: 1px solid var(--line); border-radius: 4px }
.plan text { fill: currentColor }
#hint { display: none; color: var(--dim); margin: 0 }
@media (max-width: 48rem) {
  body { font-size: 14px; padding: .7rem }
  table, tbody { display: block }
  tr:has(th) { display: none }
  tr { display: grid; grid-template-columns: repeat(auto-fit, minmax(9.5rem, 1fr)); gap: 0 .8rem;
       border-bottom: 1px solid var(--line); padding: .4rem 0 }
  td, td:first-child, #agents td:nth-child(4), #consistency td:nth-child(3) {
    display: flex; justify-content: space-between; gap: .6rem; border: 0; padding: .1rem 0; max-width: none;
    min-width: 0; text-align: right; white-space: normal; overflow-wrap: anywhere }
  td::before { content: attr(data-label); color: var(--dim); flex: 0 1 auto; min-width: min-content;
               text-align: left }
  #agents td:nth-child(2) { overflow-wrap: normal }
  td:first-child { grid-column: 1 / -1; font-weight: 600; justify-content: flex-start }
  td:first-child::before { display: none }
  td[data-label=reason] { grid-column: 1 / -1 }
  #loops td:first-child { grid-column: auto; font-weight: inherit; justify-content: space-between }
  #loops td:first-child::before { display: inline }
  td.empty { display: none !important }
  #agents.many ~ #hint { display: block }
  #agents.many tr { cursor: pointer }
  #agents.many tr:not(.open) { grid-template-columns: 1fr auto 4rem; padding: .15rem 0 }
  #agents.many tr:not(.open) td:first-child { grid-column: auto; font-weight: inherit }
  #agents.many tr:not(.open) td:nth-child(n+5) { display: none }
  #agents.many tr:not(.open) td::before { display: none }
  #agents.many tr:not(.open) td:nth-child(3) { justify-content: flex-end }
}
</style>
<header><h1>SHARE edge</h1><b id="mark">…</b><a id="room" hidden>live room</a><span id="about"></span>
</header>
<ul id="trouble" class="trouble"></ul>
<details id="troubles" hidden><summary></summary><ul class="trouble"></ul></details>
<main>
<h2>Agents <small id="counts"></small></h2>
<div class="wide"><table id="agents" class="words"></table><p id="hint">touch one for its figures</p></div>
<h2>Plan</h2><div id="plan" class="plan"></div>
<details id="plans" hidden><summary></summary><div class="plan"></div></details>
<details open><summary><h2>Agent consistency <small></small></h2></summary>
<div class="wide"><table id="consistency"></table></div></details>
<details open><summary><h2>Maps <small></small></h2></summary>
<div class="wide"><table id="maps"></table></div></details>
<details open><summary><h2>Robots <small></small></h2></summary>
<div class="wide"><table id="robots"></table></div></details>
<details open><summary><h2>Objects <small></small></h2></summary>
<div class="wide"><table id="objects"></table></div></details>
<details open><summary><h2>Clients <small></small></h2></summary>
<div class="wide"><table id="clients"></table></div></details>
<section id="headset" hidden><h2>Headset page</h2>
<p><span id="address"></span>, code for the next wearer: <b id="code"></b><br>
SHA-256: <span id="fingerprint"></span></p>
<div class="wide"><table id="wearers"></table></div></section>
<details open><summary><h2>Loops <small></small></h2></summary>
<div class="wide"><table id="loops"></table></div></details>
<details open><summary><h2>Times, ms <small></small></h2></summary>
<div class="wide"><table id="times"></table></div></details>
</main>
<svg id="svg" hidden></svg>
<script>
"use strict";
const at = id => document.getElementById(id);
const entries = x => Object.entries(x ?? {});
const text = x => x === null || x === undefined || x === "" ? "–" : String(x);
const MANY = 8;  // rows; of more, what is seldom needed is folded
const byName = new Intl.Collator("en", {numeric: true}).compare;  // agent2 before agent10
const fixed = (x, n) => Number.isFinite(x) ? x.toFixed(n) : "–";

function node(tag, content, kind) {
  const element = document.createElement(tag);
  element.textContent = content;
  if (kind) element.className = kind;
  return element;
}

function table(id, head, rows) {
  const body = rows.map(({cells, kind}) => {
    const row = node("tr", "", kind);
    row.append(...cells.map((c, k) => {
      const cell = c instanceof Node ? c : node("td", text(c));
      cell.dataset.label = head[k];
      if (cell.textContent === "–") cell.classList.add("empty");
      return cell;
    }));
    return row;
  });
  if (!body.length) body.push(node("td", "none yet", "none"));
  const top = node("tr", "");
  top.append(...head.map(h => node("th", h)));
  at(id).replaceChildren(...(rows.length ? [top] : []), ...body);
  const section = at(id).closest("details");
  if (!section) return;
  section.querySelector("small").textContent = rows.length > 1 ? rows.length : "";
  if (rows.length > MANY && !section.dataset.folded) {  // once; whoever opens it keeps it open
    section.dataset.folded = "yes";
    section.open = false;
  }
}

function foldMore(id, label, nodes) {
  at(id).hidden = !nodes.length;
  at(id).firstElementChild.textContent = nodes.length ? label : "";
  at(id).lastElementChild.replaceChildren(...nodes);
}

function duration(s) {
  if (typeof s !== "number") return "–";
  const [h, m] = [Math.floor(s / 3600), Math.floor(s / 60) % 60];
  return h ? `${h} h ${m} min` : m ? `${m} min ${Math.floor(s) % 60} s` : `${Math.floor(s)} s`;
}

const COLOURS = %COLOURS%;
let colours = {};
const nameOf = label => label.split("/")[0];  // without the run's tag
function colour(label) {
  return colours[nameOf(label)] ??= COLOURS[Object.keys(colours).length % COLOURS.length];
}

const SVG = at("svg").namespaceURI;
function shape(tag, attributes, content) {
  const element = document.createElementNS(SVG, tag);
  for (const [name, value] of entries(attributes)) element.setAttribute(name, value);
  if (content) element.textContent = content;
  return element;
}

function planOfMap(id, agents) {
  const paths = entries(agents).flatMap(([name, a]) =>
    a.parts.filter(p => p.map_id === id && p.path.length).map(p => ({name, path: p.path})));
  const here = entries(agents).filter(([n, a]) =>
    a.map_id === id && a.position && !hasLeft(reported[n] ?? {}));
  const all = [...paths.flatMap(p => p.path), ...here.map(([, a]) => a.position)];
  if (!all.length) return null;
  const bound = (k, of) => all.reduce((best, p) => of(best, p[k]), all[0][k]);
  const [x0, x1] = [bound(0, Math.min) - 1, bound(0, Math.max) + 1];
  const [y0, y1] = [bound(1, Math.min) - 1, bound(1, Math.max) + 1];
  const [width, height] = [Math.max(x1 - x0, 3), Math.max(y1 - y0, 3)];
  const unit = Math.max(width, height) / 40;  // m, of a mark
  const [X, Y] = [x => x - x0, y => y1 - y];
  const svg = shape("svg", {viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": `map ${id}`});
  const rule = (x1, y1, x2, y2) =>
    svg.append(shape("line", {x1, y1, x2, y2, stroke: "#8883", "stroke-width": unit / 15}));
  for (let x = Math.ceil(x0); x < x0 + width; x++) rule(X(x), 0, X(x), height);
  for (let y = Math.ceil(y1 - height); y < y1; y++) rule(0, Y(y), width, Y(y));
  for (const {name, path} of paths)
    svg.append(shape("polyline", {points: path.map(p => `${X(p[0])},${Y(p[1])}`).join(" "), fill: "none",
      stroke: colour(name), "stroke-width": unit / 4, "stroke-linejoin": "round"}));
  for (const [name, a] of here) {
    const [x, y] = [X(a.position[0]), Y(a.position[1])];
    const turn = `translate(${x} ${y}) rotate(${-a.heading * 180 / Math.PI}) scale(${unit})`;
    const outline = {fill: "none", stroke: colour(name), "stroke-width": .3};
    const lost = isLost(reported[name] ?? {});
    svg.append(shape("path", {transform: turn, opacity: lost ? .5 : 1, ...a.kind === "robot"
      ? {d: "M1 0A1 1 0 1 1 1 -.01M0 0H1", ...outline}
      : {d: "M0 0L1.6 -.9V.9Z", ...lost ? outline : {fill: colour(name)}}}));
    const label = lost ? `${name}: ${reported[name].state}` : name;
    svg.append(shape("text", {x: x + unit, y: y - unit, "font-size": 1.8 * unit}, label));
  }
  const figure = document.createElement("figure");
  const who = here.map(([name]) => name).join(", ") || "nobody now";
  figure.append(svg, node("figcaption", `map ${id}, 1 m a square: ${who}`));
  return figure;
}

function showPlan(plan) {
  const ids = [...new Set(entries(plan.agents).flatMap(([, a]) => a.parts.map(p => p.map_id)))];
  const members = id => entries(plan.agents).filter(([, a]) => a.map_id === id && a.position).length;
  const figures = ids.sort((a, b) => members(b) - members(a))
    .map(id => planOfMap(id, plan.agents)).filter(Boolean);
  const first = figures.length > 4 ? 3 : 4;
  at("plan").replaceChildren(
    ...(figures.length ? figures.slice(0, first) : [node("span", loading || "no path yet", "none")]));
  foldMore("plans", `${figures.length - first} more maps`, figures.slice(first));
}

// Agents whose trouble is the same share a line.
function agentTroubles(agents) {
  const names = new Map();
  for (const [name, a] of agents)
    for (const line of a.trouble ?? []) names.set(line, [...names.get(line) ?? [], name]);
  return [...names].map(([line, who]) => {
    const more = who.length > 4 ? ` and ${who.length - 3} more` : "";
    return `${(more ? who.slice(0, 3) : who).join(", ")}${more}: ${line}`;
  });
}

const opened = new Set();  // names of agents whose figures are shown though there are many
function makeFoldable(names) {
  at("agents").classList.toggle("many", names.length > MANY);
  [...at("agents").querySelectorAll("tr:has(td)")].forEach((row, k) => {
    row.classList.toggle("open", opened.has(names[k]));
    row.onclick = () => {
      if (!opened.delete(names[k])) opened.add(names[k]);
      row.classList.toggle("open");
    };
  });
}

let reported = {}, loading;  // agents of the newest report; that a map is read
const hasLeft = a => a.gone && !a.trouble?.length;  // else it went without a bye, not long ago
const isLost = a => !hasLeft(a) && ["LOST", "SILENT"].includes(a.state);
const isStale = a => !hasLeft(a) && a.state !== "INITIALISING" && a.pose_age_ms > 1000;
const age = ms => typeof ms !== "number" ? "–"
  : ms < 1000 ? `${fixed(ms, 0)} ms` : `${fixed(ms / 1000, 1)} s`;

const isQuarantined = a => ["quarantined", "disputed"].includes(a.consistency?.state);
const percent = log => Math.abs(100 * Math.expm1(log)).toFixed(1);
function describeConsistency(c) {
  if (c.reason || c.state === "unknown") return c.reason;
  if (typeof c.log_scale !== "number") return "";
  const sigma = `± ${fixed(100 * c.sigma, 1)} %`;
  if (!c.corrected_log_scale && Math.abs(c.log_scale) < 2 * c.sigma) return `depths agree within ${sigma}`;
  const error = `depths ${percent(c.log_scale)} ${sigma} too ${c.log_scale > 0 ? "large" : "small"}`;
  return c.corrected_log_scale ? `${error}; corrected by ${percent(c.corrected_log_scale)} %` : error;
}

let previous = null, rates = {};
function rate(name, agent, now) {
  const old = previous?.agents[name];
  if (!old || old.run !== agent.run || previous.session !== now.session) return NaN;
  const bytes = agent.bytes_up + agent.bytes_down - old.bytes_up - old.bytes_down;
  return bytes / (now.uptime_s - previous.uptime_s) / 1000;
}

function updateRates(now) {
  if (previous?.session === now.session && now.uptime_s - previous.uptime_s < 1) return;
  rates = Object.fromEntries(entries(now.agents).map(([name, a]) => [name, rate(name, a, now)]));
  previous = now;
}

function mark(content, bad) {
  at("mark").textContent = content;
  at("mark").className = bad ? "bad" : "";
}

function named(name) {
  const cell = node("td", name), swatch = document.createElement("i");
  swatch.style.background = colour(name);
  cell.prepend(swatch);
  return cell;
}

function show(now) {
  updateRates(now);
  reported = now.agents ?? {};
  Object.keys(now.agents ?? {}).forEach(colour);  // in the order in which they came, as in the live room
  const isTroubled = a => a.trouble?.length > 0;
  const isMany = entries(now.agents).length > MANY;
  const agents = entries(now.agents).sort(([a, x], [b, y]) =>
    hasLeft(x) - hasLeft(y) || (isMany && isTroubled(y) - isTroubled(x)) || byName(a, b));
  const trouble = [...now.trouble ?? [], ...agentTroubles(agents)];
  const count = matches => entries(now.agents).filter(([, a]) => matches(a)).length;
  const agentCount = n => `${n} agent${n === 1 ? "" : "s"}`;
  const stale = count(a => isLost(a) || isStale(a));
  const quarantined = count(a => !hasLeft(a) && isQuarantined(a));
  const degraded = now.degraded ?? [];
  const warnings = degraded.length ? ["degraded"] : [];
  if (stale) warnings.push(`${agentCount(stale)} without a current pose`);
  if (quarantined) warnings.push(`${agentCount(quarantined)} quarantined`);
  loading = now.loading;
  const words = warnings.join(", ") || loading || "ok";
  mark(trouble.length ? "trouble" : words, trouble.length || warnings.length);
  const lines = trouble.concat(degraded, now.refused ?? []).map(t => node("li", t));
  const first = lines.length > MANY ? MANY - 2 : MANY;
  at("trouble").replaceChildren(...lines.slice(0, first));
  foldMore("troubles", `${lines.length - first} more lines`, lines.slice(first));
  const about = [`up ${duration(now.uptime_s)}`];
  if (now.waiting) about.push(`${now.waiting} keyframe${now.waiting === 1 ? "" : "s"} waiting`);
  if (typeof now.last_solve_s === "number") about.push(`solved ${duration(now.last_solve_s)} ago`);
  if (now.failed_steps) about.push(`failed steps ${now.failed_steps}`);
  at("room").hidden = !now.live_room;
  const port = now.live_room?.split(":").pop();
  if (port) at("room").href = `${location.protocol}//${location.hostname}:${port}/`;
  if (now.policy) about.push(`policy ${now.policy}`);
  if (now.version) about.push(`SHARE ${now.version}`);
  at("about").textContent = about.join(" · ");
  const gone = count(hasLeft), troubled = count(isTroubled);
  at("counts").textContent = isMany ? [`${agents.length - gone}`, troubled && `${troubled} in trouble`,
    gone && `${gone} gone`].filter(Boolean).join(", ") : "";
  table("agents",
    ["name", "state", "pose age", "reason", "kind", "poses come after", "QoE (target)", "delay",
     "keyframes", "rate", "corrections", "map", "kB/s", "loops"],
    agents.map(([name, a]) => ({kind: hasLeft(a) ? "gone" : "", cells: [
      named(name), node("td", hasLeft(a) ? "gone" : text(a.state), isLost(a) ? "bad" : ""),
      node("td", hasLeft(a) ? "–" : age(a.pose_age_ms), isStale(a) ? "bad" : ""),
      a.reason, a.kind, a.gone ? "–" : age(a.pose_ms),
      Number.isFinite(a.qoe) ? `${fixed(a.qoe, 2)} (${fixed(a.qoe_target, 2)})` : "–", age(a.delay_ms),
      a.keyframes,
      Number.isFinite(a.rate_hz) ? `${fixed(a.rate_hz, 1)} Hz` : "–", a.corrections, a.map_id,
      a.gone ? "–" : fixed(rates[name], 1), `${text(a.loops?.accepted)} of ${text(a.loops?.tried)}`]})));
  makeFoldable(agents.map(([name]) => name));
  table("consistency", ["name", "state", "reason"],
    agents.filter(([, a]) => a.consistency).map(([name, a]) => ({kind: hasLeft(a) ? "gone" : "", cells: [
      name, node("td", a.consistency.state, isQuarantined(a) && !hasLeft(a) ? "bad" : ""),
      describeConsistency(a.consistency)]})));
  table("maps", ["map", "keyframes", "agents"], entries(now.maps).map(([id, count]) => ({cells: [
    id, typeof count === "object" ? count?.keyframes : count,
    agents.filter(([, a]) => String(a.map_id) === id).map(([name]) => name).join(", ")]})));
  const place = p => p ? p.slice(0, 2).map(v => fixed(v, 2)).join(", ") : "–";
  table("robots", ["robot", "x, y (m)", "map", "what it does"], entries(now.robots).map(([name, robot]) =>
    ({cells: [name, place(robot.pose), robot.map_id, robot.text]})));
  table("objects", ["object", "kind", "owner", "x, y (m)", "map"], entries(now.objects).map(([id, it]) =>
    ({cells: [id, it.kind, it.owner, place(it.position), it.map_id]})));
  table("clients", ["client", "drives a robot", "refused messages", "the last"],
    entries(now.clients).map(([, one]) => ({cells: [
      one.name, one.drives_robot ? "yes" : "", one.refused_messages, one.last_refusal]})));
  showHeadset(now.headset);
  const loops = now.loops ?? {};
  table("loops", ["tried", "accepted", "waiting for a supporting loop", "in the maps", "merges"],
    now.loops ? [{cells: [loops.tried, loops.accepted, loops.waiting, loops.in_map, now.merges?.done]}] : []);
  table("times", ["step", "p50", "p95", "max", "count"],
    entries(now).filter(([k, t]) => k.endsWith("_ms") && t && "p50" in t).map(([k, t]) => ({cells: [
      k.slice(0, -3), fixed(t.p50, 1), fixed(t.p95, 1), fixed(t.max, 1), t.n]})));
}

function showHeadset(headset) {
  at("headset").hidden = !headset;
  if (!headset) return;
  at("address").textContent = headset.address;
  at("code").textContent = headset.code || "on the edge's terminal";
  at("fingerprint").textContent = headset.fingerprint;
  const mm = (x, unit) => Number.isFinite(x) ? `${fixed(x, 1)} ${unit}` : "–";
  table("wearers",
    ["wearer", "device of", "page", "mode", "lag p50", "p95", "p99", "over 20 ms", "alignment", "drift"],
    entries(headset.wearers).map(([name, wearer]) => ({kind: wearer.is_connected ? "" : "gone", cells: [
      name, wearer.agent, wearer.is_connected ? "connected" : "away", wearer.mode,
      age(wearer.p50_ms), age(wearer.p95_ms), age(wearer.p99_ms),
      wearer.frames && `${wearer.over_20ms} of ${wearer.frames}`,
      mm(wearer.alignment_mm, "mm"), mm(wearer.drift_mm_s, "mm/s")]})));
}

async function refresh() {
  try {
    const answer = await fetch("snapshot.json", {signal: AbortSignal.timeout(4000)});
    if (!answer.ok) throw new Error((await answer.text()).trim());
    show(await answer.json());
    document.querySelector("main").className = "";
  } catch (error) {
    mark(error instanceof TypeError || error.name === "TimeoutError" ? "no answer" : error.message, true);
    document.querySelector("main").className = "stale";
  }
  setTimeout(refresh, 300);
}
// after a first report, which has the order of colours
async function refreshPlan() {
  try {
    const answer = await fetch("plan.json", {signal: AbortSignal.timeout(4000)});
    if (answer.ok) showPlan(await answer.json());
  } catch {}  // the mark says that there is no answer
  setTimeout(refreshPlan, 1000);
}
refresh().then(refreshPlan);
</script>
</html>
"""
PAGE = _TEMPLATE.replace("%COLOURS%", json.dumps([hex_colour(colour) for colour in AGENT_COLOURS]))
