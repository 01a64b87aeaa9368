// The room as it is drawn: agents, objects, map points, pointers and the panel, from the state of the page.
import { Labels } from "./labels.js";
import { identity, multiply } from "./math.js";
import { predictPose } from "./prediction.js";
import { STANDING } from "./room.js";

const STILL = [0, 0, 0];
const WHITE = [1, 1, 1];
const POINTS = [0.62, 0.74, 0.85];
export const LABEL_SHARE = 0.027;  // of the distance, in a headset; within
const [LEAST_LABEL_M, MOST_LABEL_M] = [0.04, 0.4];
const OWNER = 0.75;  // of an object, in that size

export class Scene {
    #items = [];  // agents as drawn, made once each: {T, model, foot}
    #count = 0;
    #paths = new Map();  // by name: {lines, revision}
    #points = null;
    #pointsRevision = 0;
    #label = new Float32Array(16);
    #model = new Float32Array(16);
    #grid = new Float32Array(16);
    #product = identity();

    constructor(renderer, room) {
        this.renderer = renderer;
        this.room = room;
        this.labels = new Labels(renderer);
    }

    // Once a frame, before its views. toPage: from a stamp to the page's clock.
    update(mapId, displayMs, clock) {
        this.room.update(displayMs);
        this.#count = 0;
        for (const agent of this.room.agents.values()) {
            if (agent.mapId !== mapId) continue;
            const item = (this.#items[this.#count++] ??= newItem());
            item.agent = agent;
            const stampMs = clock.toPage(agent.stampMs);
            const aheadS = stampMs === null ? 0 : (displayMs - stampMs) / 1000;
            predictPose(item.T, agent.T, agent.velocity ?? STILL, agent.angularVelocity ?? STILL, aheadS);
            item.model.set(item.T);
            this.#setFoot(item.foot, item.T);
            this.#updatePath(agent);
        }
        if (this.#pointsRevision !== this.room.points.revision) {
            this.#pointsRevision = this.room.points.revision;
            const { xyz, count } = this.room.points;
            this.#points = this.renderer.setPoints(this.#points, xyz, count);
        }
    }

    // frame: {mapId, floorZ, eye, T_map_camera, labelShare, pointers, hovered, panel, isFlat, hidesOwn}; eye in the map; texts are
    // level with a camera, or turned to the eye where it is null.
    draw(frame) {
        const { renderer, room } = this;
        if (frame.mapId !== null) {
            if (frame.isFlat) this.#drawGrid(frame);
            for (let k = 0; k < this.#count; k++) this.#drawAgent(this.#items[k], frame);
            for (const object of room.objects.values()) {
                if (object.mapId === frame.mapId) this.#drawObject(object, frame);
            }
            if (this.#points && room.points.mapId === frame.mapId) {
                renderer.drawPoints(this.#points, identityModel, POINTS, 0.99);
            }
        }
        if (frame.mapId !== null) this.#drawLabels(frame);
        if (frame.panel?.texture) renderer.drawPicture(frame.panel.texture, frame.panel.model, 1, true);
        for (const pointer of frame.pointers) if (pointer.T_map_pointer !== null) this.#drawPointer(pointer, frame);
    }

    #drawGrid({ floorZ, eye }) {
        this.#grid.set(identityModel);
        this.#grid[12] = Math.round(eye[0]);
        this.#grid[13] = Math.round(eye[1]);
        this.#grid[14] = floorZ;
        this.renderer.drawLines("grid", this.#grid, POINTS, 0.22, 1.2, 22);
    }

    #drawAgent({ agent, model, foot }, frame) {
        const { renderer } = this;
        const alpha = agent.isPosed ? 1 : 0.35;
        const path = this.#paths.get(agent.name);
        if (path) renderer.drawLines(path.lines, identityModel, agent.colour, 0.55 * alpha, 3);
        if (agent.kind === "robot") {
            renderer.drawSolid("robot", foot, agent.colour, alpha);
            renderer.drawLines("robot", foot, WHITE, 0.5 * alpha, 1.5);
            renderer.drawSolid("arrow", foot, agent.colour, 0.8 * alpha);
        } else if (!(frame.hidesOwn && agent.name === this.room.ownAgent)) {
            renderer.drawSolid("visor", model, agent.colour, alpha);
            renderer.drawLines("frustum", model, agent.colour, alpha, 2.5);
            renderer.drawSolid("frustum", model, agent.colour, 0.18 * alpha);
        }
    }

    #drawObject(object, { hovered }) {
        const { renderer } = this;
        const colour = this.room.colour(object.owner);
        const isHot = object === hovered || object.isGrabbed;
        if (object.kind === "marker") {
            renderer.drawSolid("disc", object.shown, colour, isHot ? 0.6 : 0.35);
            renderer.drawLines("ring", object.shown, isHot ? WHITE : colour, 1, 3);
            renderer.drawSolid("pin", object.shown, colour);
        } else {
            renderer.drawSolid("cube", object.shown, colour);
            renderer.drawLines("cube", object.shown, WHITE, isHot ? 1 : 0.45, isHot ? 4 : 2);
        }
    }

    #drawPointer({ T_map_pointer, reach, isPressed }, { eye }) {
        this.#model.set(T_map_pointer);
        const length = reach ?? 1.2;
        for (let i = 8; i < 11; i++) this.#model[i] *= length;
        this.renderer.drawLines("ray", this.#model, WHITE, isPressed ? 0.9 : 0.5, isPressed ? 4 : 2.5);
        if (reach === null) return;
        const p = [0, 1, 2].map((i) => T_map_pointer[12 + i] - T_map_pointer[8 + i] * reach);
        this.#faceEye(p, 0.006 + 0.003 * reach, 0.006 + 0.003 * reach, eye);
        this.renderer.drawSolid("dot", this.#label, WHITE, 0.95);
    }

    #drawLabels(frame) {
        const { room } = this;
        for (let k = 0; k < this.#count; k++) {
            const { agent, T } = this.#items[k];
            if (frame.hidesOwn && agent.name === room.ownAgent) continue;
            const height = agent.kind === "robot" ? 0.35 : 0.22;
            const words = room.words(agent.name);
            if (words) this.#drawLabel(words, T[12], T[13], T[14] + height, frame, OWNER, 0);
            this.#drawLabel(agent.label, T[12], T[13], T[14] + height, frame, 1, words ? 1 : 0);
        }
        for (const { mapId, kind, owner, shown } of room.objects.values()) {
            if (mapId !== frame.mapId) continue;
            const height = kind === "marker" ? 0.55 : 0.15;
            this.#drawLabel(owner, shown[12], shown[13], shown[14] + height, frame, OWNER, 0);
        }
    }

    // row: 0, or above that.
    #drawLabel(text, x, y, z, { eye, T_map_camera, labelShare }, size, row) {
        const { texture, aspect } = this.labels.of(text);
        const distance = Math.hypot(x - eye[0], y - eye[1], z - eye[2]);
        const height = size * Math.min(Math.max(labelShare * distance, LEAST_LABEL_M), MOST_LABEL_M);
        const at = [x, y, z + (row + 0.5) * 1.15 * height];
        if (T_map_camera === null) this.#faceEye(at, height * aspect, height, eye);
        else this.#levelWith(T_map_camera, at, height * aspect, height);
        this.renderer.drawPicture(texture, this.#label, 1, true);
    }

    #levelWith(T, at, width, height) {
        const M = this.#label;
        M.set(T);
        for (let i = 0; i < 3; i++) {
            M[i] *= width;
            M[4 + i] *= height;
            M[12 + i] = at[i];
        }
    }

    // Upright, turned to the eye.
    #faceEye([x, y, z], width, height, eye) {
        let [fx, fy, fz] = [eye[0] - x, eye[1] - y, eye[2] - z];
        const length = Math.hypot(fx, fy, fz) || 1;
        [fx, fy, fz] = [fx / length, fy / length, fz / length];
        const level = Math.hypot(fx, fy) || 1e-6;
        const [rx, ry] = [-fy / level, fx / level];
        const M = this.#label;
        M[0] = rx * width;
        M[1] = ry * width;
        M[2] = 0;
        M[4] = -fz * ry * height;
        M[5] = fz * rx * height;
        M[6] = (fx * ry - fy * rx) * height;
        M[8] = fx;
        M[9] = fy;
        M[10] = fz;
        M[12] = x;
        M[13] = y;
        M[14] = z;
        M[3] = M[7] = M[11] = 0;
        M[15] = 1;
    }

    // A robot on the floor under its camera, ahead as the camera looks.
    #setFoot(foot, T) {
        const length = Math.hypot(T[8], T[9]) || 1;
        const [c, s] = [T[8] / length, T[9] / length];
        foot.set(identityModel);
        foot[0] = foot[5] = c;
        foot[1] = s;
        foot[4] = -s;
        foot[12] = T[12];
        foot[13] = T[13];
        foot[14] = T[14] - STANDING.robot;
    }

    #updatePath(agent) {
        if (agent.path === null) return;
        const path = this.#paths.get(agent.name) ?? { lines: null, revision: 0 };
        if (path.revision === agent.pathRevision) return;
        path.lines = this.renderer.setPath(path.lines, agent.path);
        path.revision = agent.pathRevision;
        this.#paths.set(agent.name, path);
    }
}

const newItem = () => ({ agent: null, T: identity(), model: new Float32Array(16), foot: new Float32Array(16) });
const identityModel = new Float32Array(identity());
