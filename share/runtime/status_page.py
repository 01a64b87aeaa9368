"""The status page: it fetches /snapshot.json three times a second and shows it. Self-contained."""

from __future__ import annotations

# Values from outside, such as names, are set as text, never as HTML.
PAGE = """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>SHARE edge</title>
<style>
:root { color-scheme: light dark; --line: #8884; --dim: #888; --bad: #d22; --good: #293 }
body { font: 15px/1.45 system-ui, sans-serif; margin: 0 auto; max-width: 72rem; padding: 1rem }
header { display: flex; flex-wrap: wrap; align-items: baseline; gap: .2rem 1rem }
h1 { font-size: 1.25rem; margin: 0 }
h2 { font-size: 1rem; margin: 1.4rem 0 .3rem }
header span, td.none { color: var(--dim) }
#mark { font-weight: 600; color: var(--good) }
.bad, #mark.bad { color: var(--bad) }
#trouble { margin: .5rem 0 0; padding-left: 1.2rem; color: var(--bad); overflow-wrap: anywhere }
.wide { overflow-x: auto }
table { border-collapse: collapse; font-variant-numeric: tabular-nums }
th, td { padding: .25rem .75rem .25rem 0; text-align: right; white-space: nowrap }
th { color: var(--dim); font-weight: 500; border-bottom: 1px solid var(--line) }
td { border-bottom: 1px solid var(--line) }
.words th:nth-child(-n+5), .words td:nth-child(-n+5), th:first-child, td:first-child { text-align: left }
td:first-child { max-width: 14rem; overflow: hidden; text-overflow: ellipsis }
#maps th:last-child, #maps td:last-child { text-align: left; white-space: normal }
#consistency td { text-align: left; vertical-align: top }
#consistency th { text-align: left }
#consistency td:nth-child(3) { white-space: normal; min-width: 12rem; overflow-wrap: anywhere }
tr.gone { color: var(--dim) }
#agents td:nth-child(4) { white-space: normal; min-width: 9rem; max-width: 18rem; overflow-wrap: anywhere }
.stale { opacity: .45 }
@media (max-width: 40rem) {
  body { font-size: 13px; padding: .7rem }
  th, td { padding-right: .5rem }
  td:first-child { max-width: 6.5rem }
}
</style>
<header><h1>SHARE edge</h1><b id="mark">…</b><span id="about"></span></header>
<ul id="trouble"></ul>
<main>
<h2>Agents</h2><div class="wide"><table id="agents" class="words"></table></div>
<h2>Agent consistency</h2><div class="wide"><table id="consistency"></table></div>
<h2>Maps</h2><div class="wide"><table id="maps"></table></div>
<h2>Loops</h2><div class="wide"><table id="loops"></table></div>
<h2>Times, ms</h2><div class="wide"><table id="times"></table></div>
</main>
<script>
"use strict";
const at = id => document.getElementById(id);
const entries = x => Object.entries(x ?? {});
const text = x => x === null || x === undefined || x === "" ? "–" : String(x);
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
    row.append(...cells.map(c => c instanceof Node ? c : node("td", text(c))));
    return row;
  });
  if (!body.length) body.push(node("td", "none yet", "none"));
  const top = node("tr", "");
  top.append(...head.map(h => node("th", h)));
  at(id).replaceChildren(...(rows.length ? [top] : []), ...body);
}

function duration(s) {
  if (typeof s !== "number") return "–";
  const [h, m] = [Math.floor(s / 3600), Math.floor(s / 60) % 60];
  return h ? `${h} h ${m} min` : m ? `${m} min ${Math.floor(s) % 60} s` : `${Math.floor(s)} s`;
}

const isLost = a => !a.gone && ["LOST", "SILENT"].includes(a.state);
const isStale = a => !a.gone && a.state !== "INITIALISING" && a.pose_age_ms > 1000;
const age = ms => typeof ms === "number" ? `${fixed(ms / 1000, 1)} s` : "–";

const isQuarantined = a => ["set apart", "disputed"].includes(a.consistency?.state);
const percent = log => Math.abs(100 * Math.expm1(log)).toFixed(1);
function describeConsistency(c) {
  if (c.reason) return c.reason;
  if (typeof c.log_scale !== "number") return "";
  const sigma = `± ${fixed(100 * c.sigma, 1)} %`;
  if (!c.put_right && Math.abs(c.log_scale) < 2 * c.sigma) return `depths agree within ${sigma}`;
  const error = `depths ${percent(c.log_scale)} ${sigma} too ${c.log_scale > 0 ? "large" : "small"}`;
  return c.put_right ? `${error}; corrected by ${percent(c.put_right)} %` : error;
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

function show(now) {
  updateRates(now);
  const trouble = now.trouble ?? [];
  const count = matches => entries(now.agents).filter(([, a]) => matches(a)).length;
  const agentCount = n => `${n} agent${n === 1 ? "" : "s"}`;
  const stale = count(a => isLost(a) || isStale(a));
  const quarantined = count(a => !a.gone && isQuarantined(a));
  const warnings = [];
  if (stale) warnings.push(`${agentCount(stale)} without a current pose`);
  if (quarantined) warnings.push(`${agentCount(quarantined)} quarantined`);
  mark(trouble.length ? "trouble" : warnings.join(", ") || "ok", trouble.length || warnings.length);
  at("trouble").replaceChildren(...trouble.concat(now.refused ?? []).map(t => node("li", t)));
  const about = [`up ${duration(now.uptime_s)}`];
  if (now.waiting !== undefined) about.push(`waiting ${text(now.waiting)}`);
  if (typeof now.last_solve_s === "number") about.push(`solved ${duration(now.last_solve_s)} ago`);
  if (now.failed_steps) about.push(`failed steps ${now.failed_steps}`);
  at("about").textContent = [...about, now.policy, now.version].filter(Boolean).join(" · ");
  const agents = entries(now.agents).sort(([a, x], [b, y]) => x.gone - y.gone || (a < b ? -1 : 1));
  table("agents",
    ["name", "state", "pose age", "reason", "kind", "keyframes", "corrections", "map", "kB/s", "loops"],
    agents.map(([name, a]) => ({kind: a.gone ? "gone" : "", cells: [
      name, node("td", a.gone ? "gone" : text(a.state), isLost(a) ? "bad" : ""),
      node("td", a.gone ? "–" : age(a.pose_age_ms), isStale(a) ? "bad" : ""),
      a.reason, a.kind, a.keyframes, a.corrections, a.map_id, a.gone ? "–" : fixed(rates[name], 1),
      `${text(a.loops?.accepted)} of ${text(a.loops?.tried)}`]})));
  table("consistency", ["name", "state", "reason"],
    agents.filter(([, a]) => a.consistency).map(([name, a]) => ({kind: a.gone ? "gone" : "", cells: [
      name, node("td", a.consistency.state, isQuarantined(a) && !a.gone ? "bad" : ""),
      describeConsistency(a.consistency)]})));
  table("maps", ["map", "keyframes", "agents"], entries(now.maps).map(([id, count]) => ({cells: [
    id, typeof count === "object" ? count?.keyframes : count,
    agents.filter(([, a]) => String(a.map_id) === id).map(([name]) => name).join(", ")]})));
  const loops = now.loops ?? {};
  table("loops", ["tried", "accepted", "waiting for a supporting loop", "in the maps", "merges"],
    now.loops ? [{cells: [loops.tried, loops.accepted, loops.waiting, loops.in_map, now.merges?.done]}] : []);
  table("times", ["step", "p50", "p95", "max", "count"],
    entries(now).filter(([k, t]) => k.endsWith("_ms") && t && "p50" in t).map(([k, t]) => ({cells: [
      k.slice(0, -3), fixed(t.p50, 1), fixed(t.p95, 1), fixed(t.max, 1), t.n]})));
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
refresh();
</script>
</html>
"""
