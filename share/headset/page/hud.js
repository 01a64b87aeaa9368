// The page around the picture: the pairing form, the state in words, the buttons. Texts are set as text, never as HTML.

const at = (id) => document.getElementById(id);
const NOTICE_MS = 5000;
const [PLAIN, DIM, GOOD, BAD] = ["#e8edf3", "#93a1b3", "#3fcf8e", "#ff7a70"];

// What is the case, line by line: [text, colour].
export function stateLines(app) {
    const { room, connection, placement, latency, commands } = app;
    const lines = [[app.wearer || "SHARE", PLAIN]];
    if (!connection.isConnected) lines.push([connection.text, BAD]);
    else if (!room.edge.isConnected) lines.push([room.edge.text || "the edge does not answer", BAD]);
    else lines.push([agentLine(app), app.place.mapId === null ? BAD : GOOD]);
    if (app.isInHeadset) lines.push(alignmentLine(app));
    const ms = latency.summary;
    if (ms !== null) {
        const over = Math.round((100 * ms.over_20ms) / ms.frames);
        const [p50, p95] = [ms.p50_ms, ms.p95_ms].map((value) => value.toFixed(0));
        lines.push([`pose to frame ${p50}\u00a0ms (95\u00a0%: ${p95}), ${over}\u00a0% over 20\u00a0ms`, DIM]);
    }
    const robot = [...room.commands.values()].at(-1) ?? [...room.robots.values()].at(-1);
    if (robot) lines.push([`${robot.robot}: ${room.words(robot.robot)}`, PLAIN]);
    const { text, sinceMs } = commands.notice;
    if (placement.isContradicted) lines.push(["the mount contradicts itself: share calibrate headset", BAD]);
    if (text && performance.now() - sinceMs < NOTICE_MS) lines.push([text, PLAIN]);
    return lines;
}

function agentLine({ room, place }) {
    const own = room.agents.get(room.ownAgent);
    const others = [...room.agents.values()].filter((one) => one.mapId === place.mapId && one !== own).length;
    const company = others === 1 ? "one other here" : `${others} others here`;
    if (room.ownAgent === null) return `looking on, ${others} in the map`;
    if (!own) return `${room.ownAgent} is not there: is its agent running?`;
    return `${own.name} ${own.state}, ${company}`;
}

function alignmentLine({ placement, room, alignmentMm, driftMmS }) {
    if (room.ownAgent === null) return ["no device on this headset: where it is in the map is not known", BAD];
    if (placement.mapId === null) return ["finding this headset in the map", BAD];
    const mount = placement.isCalibrated ? "" : ", mount not calibrated";
    const drift = driftMmS === null ? "" : `, drift ${driftMmS.toFixed(1)} mm/s`;
    const mode = placement.isHeld ? `follow: ${placement.whyHeld(performance.now())}, held` : placement.mode;
    return [`${mode} ±${(alignmentMm ?? 0).toFixed(0)} mm${drift}${mount}`, mount || placement.isHeld ? BAD : DIM];
}

export class Hud {
    #texts = [];
    #buttons = [];

    constructor(app) {
        this.app = app;
        at("pairing").addEventListener("submit", (event) => {
            event.preventDefault();
            const [code, name, agent] = ["code", "name", "agent"].map((id) => at(id).value.trim());
            this.app.pair(code.replaceAll(/\s/g, ""), name, agent || null);
        });
        at("enter").addEventListener("click", () => app.enterHeadset());
        this.#buttons = app.commands.buttons.map((one) => {
            const element = document.createElement("button");
            element.dataset.name = one.name;
            element.classList.toggle("stop", one.isStop);
            element.addEventListener("click", () => one.run());
            at("buttons").append(element);
            return [one, element];
        });
    }

    // canEnter: whether the browser has immersive-ar.
    setCanEnter(canEnter) {
        at("enter").hidden = !canEnter;
        at("flat").hidden = canEnter;
        if (!isSecureContext) at("flat").textContent = "A flat view: AR needs HTTPS, or a page of this machine.";
    }

    // A few times a second.
    update() {
        const { app } = this;
        const isPaired = app.connection.isPaired;
        at("bar").hidden = !isPaired || app.isInHeadset;
        if (app.isInHeadset) return;  // where nobody sees the page
        at("start").hidden = isPaired;
        at("reason").textContent = isPaired ? "" : app.connection.text === "not paired" ? "" : app.connection.text;
        const lines = isPaired ? stateLines(app) : [];
        while (this.#texts.length < lines.length) {
            const element = document.createElement("p");
            at("state").append(element);
            this.#texts.push(element);
        }
        const { width, height, left } = at("bar").getBoundingClientRect();
        const isBelow = left === 0;  // on phones
        app.preview.covered = { left: isBelow ? 0 : width, bottom: isBelow ? height : 0 };
        this.#texts.forEach((element, k) => {
            const [text, colour] = lines[k] ?? ["", PLAIN];
            if (element.textContent !== text) element.textContent = text;
            element.style.color = colour;
            element.hidden = text === "";
        });
        for (const [one, element] of this.#buttons) {
            const text = one.text();
            if (element.textContent !== text) element.textContent = text;
            element.hidden = !one.isShown();
            element.disabled = !one.isEnabled();
            element.setAttribute("aria-pressed", one.isActive());
        }
    }
}
