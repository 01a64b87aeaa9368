// What a ray does in the room: it presses buttons, places cubes and markers, drags them, removes them. A pointer is a
// controller, a pinching hand, a finger or a mouse:
//   {origin, direction (in the map), T_map_pointer (null: on a flat screen), isPressed}
import { identity, inverse, multiply, rotate } from "./math.js";
import { CUBE_EDGE } from "./geometry.js";
import { poseOf } from "./room.js";

const PUT_MS = 34;  // between two puts while dragging
const CUBE_AHEAD_M = 0.25;  // of the hand that places it
const MAX_REACH_M = 30;  // of a ray along the floor
const SIZES = { cube: [0, 0.13], marker: [0.25, 0.27] };  // m: height above its origin, radius, of what a ray hits

export class Interaction {
    armed = null;  // what the next press does: "cube", "marker", "remove"
    hovered = null;  // the object that a ray is on
    #grabs = new Map();  // by pointer

    // place: {mapId, floorZ, T_map_local} of the present frame; panel: null in the preview.
    constructor(room, connection, place) {
        this.room = room;
        this.connection = connection;
        this.place = place;
        this.panel = null;
        this.may = false;  // objects
        this.owner = "";
    }

    arm(what) {
        this.armed = this.armed === what ? null : what;
    }

    // Look where the pointers point, once a frame.
    hover(pointers) {
        this.hovered = null;
        if (this.panel !== null) this.panel.hovered = null;
        for (const pointer of pointers) {
            if (this.#grabs.has(pointer)) continue;
            pointer.reach = null;
            const onPanel = this.#onPanel(pointer);
            if (onPanel !== null) {
                pointer.reach = onPanel.distance;
                this.panel.hovered ??= onPanel.button;
                continue;
            }
            const found = this.place.mapId === null ? null : this.#objectOn(pointer);
            if (found !== null) {
                pointer.reach = found.distance;
                this.hovered = found.object;
            } else if (this.armed === "marker") {
                pointer.reach = this.#reach(pointer, this.place.floorZ);
            }
        }
    }

    // Whether it took the press: a finger on nothing turns the preview.
    press(pointer, nowMs) {
        pointer.isPressed = true;
        const onPanel = this.#onPanel(pointer);
        if (onPanel !== null) {
            onPanel.button?.run();
            return true;
        }
        if (!this.may || this.place.mapId === null) return false;
        if (this.armed === "cube" || this.armed === "marker") return this.#make(this.armed, pointer, nowMs);
        const object = this.#objectOn(pointer)?.object ?? null;
        if (object === null) return false;
        if (this.armed === "remove") {
            this.connection.remove(object.id);
            this.room.objects.delete(object.id);
            this.armed = null;
        } else {
            this.#grab(object, pointer);
        }
        return true;
    }

    move(pointer, nowMs) {
        const grab = this.#grabs.get(pointer);
        if (grab === undefined || this.place.mapId === null) return;
        if (!this.room.objects.has(grab.id)) {
            this.#grabs.delete(pointer);  // somebody removed it
            return;
        }
        if (!this.#follow(grab, pointer)) return;
        this.room.move(grab.id, grab.kind, this.owner, this.place.mapId, grab.T);
        if (nowMs - grab.putMs >= PUT_MS) this.#put(grab, nowMs);
    }

    release(pointer, nowMs) {
        pointer.isPressed = false;
        const grab = this.#grabs.get(pointer);
        if (grab === undefined) return;
        this.#grabs.delete(pointer);
        const object = this.room.objects.get(grab.id);
        if (object === undefined) return;
        object.isGrabbed = false;
        this.#put(grab, nowMs);
    }

    // The present map was joined to another.
    joined(T_new_old) {
        for (const grab of this.#grabs.values()) {
            multiply(grab.T, T_new_old, grab.T);
            if (grab.shift === undefined) continue;
            grab.planeZ = grab.T[14];
            rotate(grab.shift, T_new_old, grab.shift);
        }
    }

    #make(kind, pointer, nowMs) {
        const T = identity();
        if (kind === "cube" && pointer.T_map_pointer !== null) {
            T.set(pointer.T_map_pointer);
            for (let i = 0; i < 3; i++) T[12 + i] += pointer.direction[i] * CUBE_AHEAD_M;
        } else {
            const distance = this.#reach(pointer, this.place.floorZ);
            if (distance === null) return false;
            for (let i = 0; i < 2; i++) T[12 + i] = pointer.origin[i] + pointer.direction[i] * distance;
            T[14] = this.place.floorZ + (kind === "cube" ? CUBE_EDGE / 2 : 0);
        }
        const [id] = crypto.getRandomValues(new Uint32Array(1));
        const object = this.room.move(id >>> 1, kind, this.owner, this.place.mapId, T);  // below 2^31
        this.armed = null;
        this.#grab(object, pointer);
        this.#put(this.#grabs.get(pointer), nowMs);
        return true;
    }

    // A marker, and anything on a flat screen, moves along a level plane; else as if it were fixed to the hand.
    #grab(object, pointer) {
        const grab = { id: object.id, kind: object.kind, T: Float64Array.from(object.T), putMs: -Infinity };
        if (object.kind === "marker" || pointer.T_map_pointer === null) {
            const away = [0, 1, 2].map((i) => object.T[12 + i] - pointer.origin[i]);
            const distance = this.#reach(pointer, object.T[14]) ?? Math.hypot(...away);
            grab.planeZ = object.T[14];
            grab.shift = [0, 1, 2].map((i) => object.T[12 + i] - (pointer.origin[i] + pointer.direction[i] * distance));
        } else {
            grab.T_pointer_object = multiply(identity(), inverse(identity(), pointer.T_map_pointer), object.T);
        }
        object.isGrabbed = object.isHeld = true;
        this.#grabs.set(pointer, grab);
    }

    #follow(grab, pointer) {
        if (grab.T_pointer_object !== undefined) {
            multiply(grab.T, pointer.T_map_pointer, grab.T_pointer_object);
            pointer.reach = null;
            return true;
        }
        if (grab.kind === "marker" && pointer.T_map_pointer !== null) grab.planeZ = this.place.floorZ;
        const distance = this.#reach(pointer, grab.planeZ);
        if (distance === null) return false;
        pointer.reach = distance;
        const { origin, direction } = pointer;
        for (let i = 0; i < 2; i++) grab.T[12 + i] = origin[i] + direction[i] * distance + grab.shift[i];
        grab.T[14] = grab.planeZ;
        return true;
    }

    #put(grab, nowMs) {
        const object = this.room.objects.get(grab.id);
        if (!object.T.every(Number.isFinite)) return;  // a ray that a headset has lost
        object.request = this.connection.put(object.id, object.kind, object.mapId, ...poseOf(object.T));
        grab.putMs = nowMs;
    }

    #onPanel(pointer) {
        return this.panel?.hit(this.place.T_map_local, pointer.origin, pointer.direction) ?? null;
    }

    // Along the ray to a level plane; null where it does not meet it in the room.
    #reach({ origin, direction }, z) {
        const distance = (z - origin[2]) / direction[2];
        return distance > 0 && distance < MAX_REACH_M ? distance : null;
    }

    // The object that a ray meets first; one that the hand is in counts too.
    #objectOn({ origin, direction }) {
        let [best, distance] = [null, MAX_REACH_M];
        for (const object of this.room.objects.values()) {
            if (object.mapId !== this.place.mapId) continue;
            const [lift, radius] = SIZES[object.kind] ?? SIZES.cube;
            const x = object.T[12] - origin[0];
            const y = object.T[13] - origin[1];
            const z = object.T[14] + lift - origin[2];
            const along = Math.max(x * direction[0] + y * direction[1] + z * direction[2], 0);
            const aside = Math.hypot(x - along * direction[0], y - along * direction[1], z - along * direction[2]);
            if (aside < radius && along < distance) [best, distance] = [object, along];
        }
        return best === null ? null : { object: best, distance };
    }
}
