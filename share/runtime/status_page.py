"""The page for people: asks for /snapshot.json thrice a second and shows it. Needs nothing from elsewhere."""

from __future__ import annotations

# Whatever comes from outside, names above all, is set as text and never as HTML.
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
#claims td { text-align: left; vertical-align: top }
#claims th { text-align: left }
#claims td:nth-child(3) { white-space: normal; min-width: 12rem; overflow-wrap: anywhere }
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
<h2>Whose claims agree</h2><div class="wide"><table id="claims"></table></div>
<h2>Maps</h2><div class="wide"><table id="maps"></table></div>
<h2>Loops</h2><div class="wide"><table id="loops"></table></div>
<h2>Times, ms</h2><div class="wide"><table id="times"></table></div>
</main>
<script>
"use strict";
const at = id => document.getElementById(id);
const entries = x => Object.entries(x ?? {});
const shown = x => x === null || x === undefined || x === "" ? "–" : String(x);
const fixed = (x, n) => Number.isFinite(x) ? x.toFixed(n) : "–";

function node(tag, text, kind) {
  const made = document.createElement(tag);
  made.textContent = text;
  if (kind) made.className = kind;
  return made;
}

function table(id, head, rows) {
  const body = rows.map(({cells, kind}) => {
    const row = node("tr", "", kind);
    row.append(...cells.map(c => c instanceof Node ? c : node("td", shown(c))));
    return row;
  });
  if (!body.length) body.push(node("td", "none yet", "none"));
  const top = node("tr", "");
  top.append(...head.map(h => node("th", h)));
  at(id).replaceChildren(...(rows.length ? [top] : []), ...body);
}

function lasted(s) {
  if (typeof s !== "number") return "–";
  const [h, m] = [Math.floor(s / 3600), Math.floor(s / 60) % 60];
  return h ? `${h} h ${m} min` : m ? `${m} min ${Math.floor(s) % 60} s` : `${Math.floor(s)} s`;
}

const lost = a => !a.gone && ["LOST", "SILENT"].includes(a.state);
const late = a => !a.gone && a.state !== "INITIALISING" && a.pose_age_ms > 1000;
const aged = ms => typeof ms === "number" ? `${fixed(ms / 1000, 1)} s` : "–";

const apart = a => ["set apart", "disputed"].includes(a.consistency?.state);
const percent = log => Math.abs(100 * Math.expm1(log)).toFixed(1);
function claim(c) {
  if (c.reason) return c.reason;
  if (typeof c.log_scale !== "number") return "";
  const sigma = `± ${fixed(100 * c.sigma, 1)} %`;
  if (!c.put_right && Math.abs(c.log_scale) < 2 * c.sigma) return `depths as the others', ${sigma}`;
  const off = `depths ${percent(c.log_scale)} ${sigma} too ${c.log_scale > 0 ? "large" : "small"}`;
  return c.put_right ? `${off}; put right by ${percent(c.put_right)} %` : off;
}

let before = null, rates = {};
function rate(name, agent, now) {
  const old = before?.agents[name];
  if (!old || old.run !== agent.run || before.session !== now.session) return NaN;
  const bytes = agent.bytes_up + agent.bytes_down - old.bytes_up - old.bytes_down;
  return bytes / (now.uptime_s - before.uptime_s) / 1000;
}

function measure(now) {
  if (before?.session === now.session && now.uptime_s - before.uptime_s < 1) return;
  rates = Object.fromEntries(entries(now.agents).map(([name, a]) => [name, rate(name, a, now)]));
  before = now;
}

function mark(text, bad) {
  at("mark").textContent = text;
  at("mark").className = bad ? "bad" : "";
}

function show(now) {
  measure(now);
  const trouble = now.trouble ?? [];
  const unwell = entries(now.agents).filter(([, a]) => lost(a) || late(a)).length;
  const without = `${unwell} agent${unwell === 1 ? "" : "s"} without a current pose`;
  const odd = entries(now.agents).filter(([, a]) => !a.gone && apart(a)).length;
  const alone = `${odd} agent${odd === 1 ? "" : "s"} kept apart`;
  const words = [...(unwell ? [without] : []), ...(odd ? [alone] : [])].join(", ");
  mark(trouble.length ? "trouble" : words || "ok", trouble.length || words);
  at("trouble").replaceChildren(...trouble.concat(now.refused ?? []).map(t => node("li", t)));
  const about = [`up ${lasted(now.uptime_s)}`];
  if (now.waiting !== undefined) about.push(`waiting ${shown(now.waiting)}`);
  if (typeof now.last_solve_s === "number") about.push(`solved ${lasted(now.last_solve_s)} ago`);
  if (now.failed_steps) about.push(`failed steps ${now.failed_steps}`);
  at("about").textContent = [...about, now.policy, now.version].filter(Boolean).join(" · ");
  const agents = entries(now.agents).sort(([a, x], [b, y]) => x.gone - y.gone || (a < b ? -1 : 1));
  table("agents",
    ["name", "state", "pose age", "why", "kind", "keyframes", "corrections", "map", "kB/s", "loops"],
    agents.map(([name, a]) => ({kind: a.gone ? "gone" : "", cells: [
      name, node("td", a.gone ? "gone" : shown(a.state), lost(a) ? "bad" : ""),
      node("td", a.gone ? "–" : aged(a.pose_age_ms), late(a) ? "bad" : ""),
      a.reason, a.kind, a.keyframes, a.corrections, a.map_id, a.gone ? "–" : fixed(rates[name], 1),
      `${shown(a.loops?.accepted)} of ${shown(a.loops?.tried)}`]})));
  table("claims", ["name", "it", "why"], agents.filter(([, a]) => a.consistency).map(([name, a]) => ({
    kind: a.gone ? "gone" : "", cells: [
      name, node("td", a.consistency.state, apart(a) && !a.gone ? "bad" : ""), claim(a.consistency)]})));
  table("maps", ["map", "keyframes", "agents"], entries(now.maps).map(([id, count]) => ({cells: [
    id, typeof count === "object" ? count?.keyframes : count,
    agents.filter(([, a]) => String(a.map_id) === id).map(([name]) => name).join(", ")]})));
  const loops = now.loops ?? {};
  table("loops", ["tried", "accepted", "waiting for a witness", "in the maps", "merges"],
    now.loops ? [{cells: [loops.tried, loops.accepted, loops.waiting, loops.in_map, now.merges?.done]}] : []);
  table("times", ["step", "p50", "p95", "max", "times"],
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
