// The panel that floats before the wearer: lines of state, and buttons that a ray hits. It stays where it is while one
// looks at it, and comes along when the wearer turns or walks away.
import { identity, inverse, multiply, transformPoint } from "./math.js";

const [WIDTH_M, HEIGHT_M] = [0.48, 0.36];
const [WIDTH, HEIGHT] = [1024, 768];  // in which it is laid out
const SCALE = 0.75;  // to pixels: as many as a headset has where it hangs
const COLUMNS = 4;
const [BUTTON_TOP, BUTTON_HEIGHT, GAP, MARGIN] = [416, 96, 14, 32];
const [AHEAD_M, BELOW_M] = [0.8, 0.36];
const MAX_TURNED = 0.75;  // rad, and
const MAX_AWAY_M = 0.5;  // beyond which it comes along
const REDRAWN_MS = 500;  // a drawing costs ten frames

export class Panel {
    T_local_panel = identity();
    hovered = null;
    texture = null;
    #model = new Float32Array(16);
    #matrix = identity();
    #scratch = identity();
    #canvas = document.createElement("canvas");
    #placed = null;  // {x, z, yaw} of the viewer
    #shown = "";
    #drawnMs = -Infinity;
    #hit = new Float64Array(3);
    #ahead = new Float64Array(3);

    constructor(renderer, buttons) {
        this.renderer = renderer;
        this.buttons = buttons;
        this.#canvas.width = SCALE * WIDTH;
        this.#canvas.height = SCALE * HEIGHT;
    }

    // Of a new session, or of a space that was reset.
    forget() {
        this.#placed = null;
    }

    // Local space: y up, the viewer looks along its -z.
    place(T) {
        const yaw = Math.atan2(-T[8], -T[10]);  // of where the viewer looks, about -y
        const was = this.#placed;
        if (was !== null) {
            const turned = Math.abs(Math.atan2(Math.sin(yaw - was.yaw), Math.cos(yaw - was.yaw)));
            if (turned < MAX_TURNED && Math.hypot(T[12] - was.x, T[13] - was.y, T[14] - was.z) < MAX_AWAY_M) return;
        }
        this.#placed = { x: T[12], y: T[13], z: T[14], yaw };
        const [s, c] = [Math.sin(yaw), Math.cos(yaw)];
        const tilt = 0.35;  // leans back towards the eyes
        const [st, ct] = [Math.sin(tilt), Math.cos(tilt)];
        // x to the wearer's right, y up, z to the wearer
        this.T_local_panel.set([-c, 0, s, 0, s * st, ct, c * st, 0, -s * ct, st, -c * ct, 0]);
        this.T_local_panel.set([T[12] + s * AHEAD_M, T[13] - BELOW_M, T[14] + c * AHEAD_M, 1], 12);
    }

    // Where a ray meets it in the map: {distance, button}; null beside it.
    hit(T_map_local, origin, direction) {
        const T_panel_map = inverse(this.#scratch, multiply(this.#scratch, T_map_local, this.T_local_panel));
        const [x, y, z] = transformPoint(this.#hit, T_panel_map, origin);
        for (let i = 0; i < 3; i++) this.#ahead[i] = origin[i] + direction[i];
        transformPoint(this.#ahead, T_panel_map, this.#ahead);
        const distance = z / (z - this.#ahead[2]);
        if (!(distance > 0)) return null;
        const u = (x + distance * (this.#ahead[0] - x)) / WIDTH_M + 0.5;
        const v = 0.5 - (y + distance * (this.#ahead[1] - y)) / HEIGHT_M;
        if (u < 0 || u > 1 || v < 0 || v > 1) return null;
        return { distance, button: this.#buttonAt(u * WIDTH, v * HEIGHT) };
    }

    // The centre of a button in local space.
    centreOf(name) {
        const shown = this.buttons.filter((one) => one.isShown());
        const [x, y, w, h] = buttonBox(shown.findIndex((one) => one.name === name));
        const p = [((x + w / 2) / WIDTH - 0.5) * WIDTH_M, (0.5 - (y + h / 2) / HEIGHT) * HEIGHT_M, 0];
        return transformPoint([0, 0, 0], this.T_local_panel, p);
    }

    draw(T_map_local, lines, nowMs) {
        if (nowMs - this.#drawnMs > REDRAWN_MS || this.hovered !== this.drawnHovered) this.#redraw(lines(), nowMs);
        multiply(this.#matrix, T_map_local, this.T_local_panel);
        this.#model.set(this.#matrix);
        for (let i = 0; i < 3; i++) {
            this.#model[i] *= WIDTH_M;
            this.#model[4 + i] *= HEIGHT_M;
        }
    }

    get model() {
        return this.#model;
    }

    #buttonAt(x, y) {
        const shown = this.buttons.filter((one) => one.isShown());
        return (
            shown.find((one, k) => {
                const [left, top, w, h] = buttonBox(k);
                return x >= left && x <= left + w && y >= top && y <= top + h && one.isEnabled();
            }) ?? null
        );
    }

    #redraw(lines, nowMs) {
        this.#drawnMs = nowMs;
        this.drawnHovered = this.hovered;
        const shown = this.buttons.filter((one) => one.isShown());
        const states = shown.map((one) => [one.text(), one.isEnabled(), one.isActive(), one === this.hovered]);
        const key = JSON.stringify([lines, states]);
        if (key === this.#shown) return;
        this.#shown = key;
        const context = this.#canvas.getContext("2d");
        context.setTransform(SCALE, 0, 0, SCALE, 0, 0);
        context.clearRect(0, 0, WIDTH, HEIGHT);
        box(context, 0, 0, WIDTH, HEIGHT, 40, "rgba(11, 16, 23, 0.86)");
        context.textBaseline = "middle";
        context.textAlign = "left";
        lines.forEach(([text, colour], k) => {
            context.font = k === 0 ? "600 44px system-ui, sans-serif" : "34px system-ui, sans-serif";
            context.fillStyle = colour;
            context.fillText(text, MARGIN + 8, 56 + 56 * k, WIDTH - 2 * MARGIN - 16);
        });
        context.textAlign = "center";
        context.font = "600 34px system-ui, sans-serif";
        shown.forEach((one, k) => {
            const [text, isEnabled, isActive, isHovered] = states[k];
            const [x, y, w, h] = buttonBox(k);
            const colour = isHovered ? "#5b6b80" : isActive ? "#3a97d4" : "#263140";
            box(context, x, y, w, h, 20, one.isStop ? (isHovered ? "#f0524f" : "#c0322f") : colour);
            context.fillStyle = isEnabled ? "#fff" : "#6b7686";
            context.fillText(text, x + w / 2, y + h / 2 + 2, w - 20);
        });
        this.texture = this.renderer.setPicture(this.texture, this.#canvas);
    }
}

function buttonBox(k) {
    const width = (WIDTH - 2 * MARGIN - (COLUMNS - 1) * GAP) / COLUMNS;
    const [column, row] = [k % COLUMNS, Math.floor(k / COLUMNS)];
    return [MARGIN + column * (width + GAP), BUTTON_TOP + row * (BUTTON_HEIGHT + GAP), width, BUTTON_HEIGHT];
}

function box(context, x, y, w, h, radius, colour) {
    context.fillStyle = colour;
    context.beginPath();
    context.roundRect(x, y, w, h, radius);
    context.fill();
}
