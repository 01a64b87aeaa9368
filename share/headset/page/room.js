// What the page knows of the room: agents, objects, robots, map points, each in its map. No drawing, no clock.
import { exp, fromPose, fromRows, identity, inverse, log, multiply, quaternionOf, transformPoint } from "./math.js";
import { easeLeft } from "./placement.js";

// share/colours.py, AGENT_COLOURS: a test holds these against it.
export const AGENT_COLOURS = [
    [58, 151, 212], [230, 159, 0], [0, 158, 115], [199, 181, 0], [213, 94, 0], [204, 121, 167],
    [0, 114, 178], [153, 153, 153], [105, 0, 255], [105, 90, 45], [0, 105, 105], [240, 165, 150],
    [0, 90, 210], [135, 75, 0], [120, 90, 150], [210, 180, 105], [135, 75, 90], [150, 150, 105],
    [120, 75, 255], [120, 195, 210], [165, 30, 210], [210, 0, 150], [255, 150, 75], [150, 195, 165],
    [240, 120, 255], [195, 0, 255], [60, 120, 75], [105, 165, 255], [135, 120, 0], [30, 150, 180],
    [225, 165, 195], [90, 195, 105],
].map((rgb) => rgb.map((value) => value / 255));

export const STANDING = { ar: 1.6, robot: 0.25 };  // m, about, of a camera above the floor
const MAX_POINTS = 20000;
const MOST_COMMANDS = 16;

export class Room {
    ownAgent = null;
    agents = new Map();  // by name
    objects = new Map();  // by id
    robots = new Map();  // by name: places that their bridges report
    commands = new Map();  // by robot: the newest state, in words
    points = { mapId: null, xyz: new Float32Array(3 * MAX_POINTS), count: 0, revision: 0 };
    edge = { isConnected: true, text: "" };
    removals = [];  // [{id, reason}] that the page has not shown yet
    #colours = new Map();

    apply(message, nowMs) {
        switch (message.type) {
            case "welcome":
                this.ownAgent = message.agent;
                this.agents.clear();  // poses name those that are there
                for (const { name } of message.agents) this.colour(name);
                break;
            case "poses":
                for (const pose of message.poses) this.#onPose(pose);
                break;
            case "objects":
                this.#onObjects(message, nowMs);
                break;
            case "receipt":
                this.#onReceipt(message);
                break;
            case "robots":
                for (const one of message.robots) this.robots.set(one.robot, one);
                break;
            case "command":
                this.commands.delete(message.robot);
                this.commands.set(message.robot, message);
                if (this.commands.size > MOST_COMMANDS) this.commands.delete(this.commands.keys().next().value);
                break;
            case "points":
                this.#onPoints(message);
                break;
            case "map_changed":
                this.#onJoined(message);
                break;
            case "edge":
                this.edge = { isConnected: message.is_connected, text: message.text };
        }
    }

    // Of an agent or a wearer, in order of appearance: three numbers, 0 to 1.
    colour(name) {
        if (!this.#colours.has(name)) {
            this.#colours.set(name, AGENT_COLOURS[this.#colours.size % AGENT_COLOURS.length]);
        }
        return this.#colours.get(name);
    }

    // What a robot does, in words; empty where nothing is known.
    words(robot) {
        return this.commands.get(robot)?.text || this.robots.get(robot)?.text || "";
    }

    // The map that the own agent is in; else one with most agents in it.
    get likelyMap() {
        const own = this.agents.get(this.ownAgent);
        if (own?.mapId) return own.mapId;
        const counts = new Map();
        for (const { mapId } of [...this.agents.values(), ...this.objects.values()]) {
            if (mapId !== null) counts.set(mapId, (counts.get(mapId) ?? 0) + 1);
        }
        return [...counts].sort((a, b) => b[1] - a[1])[0]?.[0] ?? null;
    }

    // How high the floor of a map is, m, guessed from who stands on it; objects before robots before wearers.
    floorHeight(mapId) {
        for (const one of this.objects.values()) if (one.kind === "marker" && one.mapId === mapId) return one.T[14];
        for (const kind of ["robot", "ar"]) {
            for (const one of this.agents.values()) {
                if (one.kind === kind && one.mapId === mapId) return one.T[14] - STANDING[kind];
            }
        }
        return 0;
    }

    // The page's own copy of an object that it moves: shown at once, until the receipt says otherwise.
    move(id, kind, owner, mapId, T) {
        const one = this.objects.get(id) ?? newObject(id, kind, owner);
        one.mapId = mapId;
        one.T.set(T);
        one.ease = null;
        one.isHeld = true;
        this.objects.set(id, one);
        return one;
    }

    // Bring what is drawn of the objects up to date.
    update(nowMs) {
        for (const one of this.objects.values()) {
            const left = one.ease === null ? 0 : easeLeft(nowMs - one.ease.beganMs);
            if (left === 0) one.ease = null;
            if (left === 0) one.shown.set(one.T);
            else one.shown.set(multiply(scratch, one.T, exp(scratch, one.ease.xi.map((value) => value * left))));
        }
    }

    #onPose(pose) {
        if (pose.state === "GONE") {
            this.agents.delete(pose.agent);
            return;
        }
        let one = this.agents.get(pose.agent);
        if (one === undefined) {
            const place = { mapId: null, T: identity(), path: null, pathRevision: 0 };
            one = { name: pose.agent, colour: this.colour(pose.agent), ...place };
            this.agents.set(pose.agent, one);
        }
        if (one.state !== pose.state) one.label = pose.state === "OK" ? pose.agent : `${pose.agent} · ${pose.state}`;
        one.kind = pose.kind;
        one.state = pose.state;
        one.velocity = one.angularVelocity = null;
        one.isPosed = pose.map_id !== null;
        if (!one.isPosed) return;  // it stays where it was last
        one.mapId = pose.map_id;
        fromPose(one.T, pose.position, pose.quaternion);
        one.stampMs = pose.t_ms;
        one.velocity = pose.velocity;
        one.angularVelocity = pose.angular_velocity;
        one.sigmaM = pose.sigma_m;
        one.sigmaRad = pose.sigma_rad;
        if (pose.path) {
            one.path = Float32Array.from(pose.path.flat());
            one.pathRevision++;
        }
    }

    #onObjects({ all = false, objects = [], removed = [] }, nowMs) {
        if (all) {
            const named = new Set(objects.map(({ id }) => id));
            for (const [id, one] of this.objects) if (!named.has(id) && !one.isHeld) this.objects.delete(id);
        }
        for (const { id, kind, owner, map_id: mapId, position, quaternion } of objects) {
            const one = this.objects.get(id) ?? newObject(id, kind, owner);
            this.objects.set(id, one);
            one.owner = owner;
            one.confirmed = { mapId, T: fromPose(identity(), position, quaternion) };
            if (!one.isHeld) settle(one, nowMs);
        }
        for (const { id, reason } of removed) {
            if (!this.objects.delete(id) || !reason) continue;
            this.removals.push({ id, reason });
        }
    }

    // request: what the newest change of the object was sent as; a hand may still hold it.
    #onReceipt({ request, reason }) {
        for (const one of this.objects.values()) {
            if (one.request !== request) continue;
            one.request = null;
            if (reason && one.confirmed === null) this.objects.delete(one.id);
            else if (!reason) one.confirmed = { mapId: one.mapId, T: Float64Array.from(one.T) };
            if (one.isGrabbed) return;
            one.isHeld = false;
            if (one.confirmed !== null) settle(one, 0);
        }
    }

    #onPoints({ map_id: mapId, part, count, data }) {
        const points = this.points;
        if (part === 0) points.count = 0;
        points.mapId = mapId;
        const bytes = Uint8Array.from(atob(data), (character) => character.charCodeAt(0));
        const some = Math.min(count, MAX_POINTS - points.count);
        points.xyz.set(new Float32Array(bytes.buffer, 0, 3 * some), 3 * points.count);
        points.count += some;
        points.revision++;
    }

    clearPoints() {
        this.points.mapId = null;
        this.points.count = 0;
        this.points.revision++;
    }

    // All that is in the old map is in the new one now; what the edge says of it later is eased to.
    #onJoined({ old: oldId, new: newId, T_new_old }) {
        const T = fromRows(T_new_old);
        for (const one of [...this.agents.values(), ...this.objects.values()]) {
            if (one.mapId !== oldId) continue;
            one.mapId = newId;
            multiply(one.T, T, one.T);
            one.isToEase = true;
            if (one.path) {
                transformAll(one.path, T, one.path.length / 3);
                one.pathRevision++;
            }
        }
        for (const { confirmed } of this.objects.values()) {
            if (confirmed?.mapId !== oldId) continue;
            confirmed.mapId = newId;
            multiply(confirmed.T, T, confirmed.T);
        }
        if (this.points.mapId !== oldId) return;
        this.points.mapId = newId;
        transformAll(this.points.xyz, T, this.points.count);
        this.points.revision++;
    }
}

const scratch = identity();

// isHeld: the page's own copy counts; isGrabbed: a hand has it; confirmed: what the edge holds.
function newObject(id, kind, owner) {
    const place = { mapId: null, T: identity(), shown: new Float32Array(16), ease: null, confirmed: null };
    return { id, kind, owner, ...place, request: null, isHeld: false, isGrabbed: false, isToEase: false };
}

// Let the edge's copy count; after a join, by an ease.
function settle(one, nowMs) {
    const { mapId, T } = one.confirmed;
    if (one.isToEase && one.mapId === mapId) {
        const xi = log(multiply(identity(), inverse(scratch, T), one.T));
        one.ease = { xi, beganMs: nowMs };
        one.isToEase = false;
    }
    one.mapId = mapId;
    one.T.set(T);
}

function transformAll(xyz, T, count) {
    for (let k = 0; k < count; k++) {
        const p = xyz.subarray(3 * k, 3 * k + 3);
        transformPoint(p, T, p);
    }
}

export function poseOf(T) {
    return [Array.from(T.slice(12, 15)), Array.from(quaternionOf(new Float64Array(4), T))];
}
