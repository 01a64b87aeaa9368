// The room on a flat screen: a camera that orbits by mouse or fingers, and pointers that they are.
import { identity, inverse, perspective } from "./math.js";

const LEAST_VIEW = 0.87;  // rad, of the smaller side
const MOST_VIEW = 1.4;
const [NEAREST_M, FARTHEST_M] = [1, 60];
const PER_PIXEL = 0.006;  // rad

export class Preview {
    eye = new Float64Array(3);
    projection = new Float64Array(16);
    T_camera_map = identity();
    T_map_camera = identity();
    covered = { left: 0, bottom: 0 };  // of the picture, px: the room is drawn beside it
    pointers = [];  // those of fingers that are down, and the mouse
    #target = [0, 0, -0.6];
    #wanted = null;  // {target, distance}, until the camera is moved by hand
    #yaw = -2.3;
    #pitch = 0.55;
    #distance = 7;
    #isMoved = false;
    #fingers = new Map();  // by pointerId: {x, y, pointer, isTurning}

    // interaction: told of presses, moves, releases.
    constructor(canvas, interaction) {
        this.canvas = canvas;
        this.interaction = interaction;
        canvas.addEventListener("pointerdown", (event) => this.#onDown(event));
        canvas.addEventListener("pointermove", (event) => this.#onMove(event));
        for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (event) => this.#onUp(event));
        canvas.addEventListener("pointerleave", (event) => this.#forget(event));
        canvas.addEventListener("wheel", (event) => this.#onWheel(event), { passive: false });
    }

    // Show what there is, until the camera is moved by hand. positions: [[x, y, z] ..]
    showAll(positions) {
        if (this.#isMoved || positions.length === 0) return;
        const isFirst = this.#wanted === null;
        const [low, high] = [Math.min, Math.max].map((of) => [0, 1, 2].map((i) => of(...positions.map((p) => p[i]))));
        const target = [0, 1, 2].map((i) => (low[i] + high[i]) / 2);
        const extent = Math.hypot(...[0, 1, 2].map((i) => high[i] - low[i]));
        this.#wanted = { target, distance: Math.max(3.5, 1.25 * extent + 1.5) };
        if (isFirst) [this.#target, this.#distance] = [[...target], this.#wanted.distance];
    }

    // Bring the camera up to date for a frame of so many pixels.
    update(width, height) {
        if (this.#wanted !== null) {
            const share = 0.08;
            for (let i = 0; i < 3; i++) this.#target[i] += share * (this.#wanted.target[i] - this.#target[i]);
            this.#distance += share * (this.#wanted.distance - this.#distance);
        }
        const aspect = width / height;
        const fovY = aspect >= 1 ? LEAST_VIEW : Math.min(2 * Math.atan(Math.tan(LEAST_VIEW / 2) / aspect), MOST_VIEW);
        perspective(this.projection, fovY, aspect, 0.05, 200);
        this.projection[8] = -this.covered.left / this.canvas.clientWidth;
        this.projection[9] = -this.covered.bottom / this.canvas.clientHeight;
        const [c, s] = [Math.cos(this.#pitch), Math.sin(this.#pitch)];
        const [x, y] = [Math.cos(this.#yaw), Math.sin(this.#yaw)];
        const back = [c * x, c * y, s];  // from what is looked at to the eye
        for (let i = 0; i < 3; i++) this.eye[i] = this.#target[i] + this.#distance * back[i];
        const T = this.T_map_camera;
        T.set([-y, x, 0, 0, -s * x, -s * y, c, 0, ...back, 0, ...this.eye, 1]);
        inverse(this.T_camera_map, T);
        for (const { x: left, y: top, pointer } of this.#fingers.values()) this.#point(pointer, left, top);
        this.pointers = [...this.#fingers.values()].map(({ pointer }) => pointer);
    }

    // The part of its distance that so many px of the screen show.
    shareOf(px) {
        return (2 * px) / (this.canvas.clientHeight * this.projection[5]);
    }

    #point(pointer, left, top) {
        const { clientWidth, clientHeight } = this.canvas;
        const x = (2 * left) / clientWidth - 1;
        const y = 1 - (2 * top) / clientHeight;
        const T = this.T_map_camera;
        const [a, b] = [(x + this.projection[8]) / this.projection[0], (y + this.projection[9]) / this.projection[5]];
        const d = [0, 1, 2].map((i) => a * T[i] + b * T[i + 4] - T[i + 8]);
        const length = Math.hypot(...d);
        for (let i = 0; i < 3; i++) {
            pointer.direction[i] = d[i] / length;
            pointer.origin[i] = this.eye[i];
        }
    }

    #fingerOf(event) {
        let finger = this.#fingers.get(event.pointerId);
        if (finger === undefined) {
            const state = { T_map_pointer: null, isPressed: false, reach: null };
            const pointer = { origin: [0, 0, 0], direction: [0, 0, -1], ...state };
            finger = { pointer, isTurning: false, button: 0 };
            this.#fingers.set(event.pointerId, finger);
        }
        return finger;
    }

    #onDown(event) {
        this.canvas.setPointerCapture(event.pointerId);
        const finger = this.#fingerOf(event);
        [finger.x, finger.y, finger.button] = [event.offsetX, event.offsetY, event.button];
        this.#point(finger.pointer, finger.x, finger.y);
        finger.isTurning = event.button !== 0 || !this.interaction.press(finger.pointer, performance.now());
    }

    #onMove(event) {
        const finger = this.#fingerOf(event);
        const [dx, dy] = [event.offsetX - (finger.x ?? event.offsetX), event.offsetY - (finger.y ?? event.offsetY)];
        const spread = this.#spread();
        [finger.x, finger.y] = [event.offsetX, event.offsetY];
        this.#point(finger.pointer, finger.x, finger.y);
        if (!finger.isTurning) {
            this.interaction.move(finger.pointer, performance.now());
            return;
        }
        this.#isMoved = true;
        this.#wanted = null;
        const turning = [...this.#fingers.values()].filter((one) => one.isTurning).length;
        if (turning > 1 || finger.button !== 0 || event.shiftKey) this.#shift(dx / turning, dy / turning);
        else this.#turn(dx, dy);
        if (turning > 1 && spread > 0) this.#zoom(spread / this.#spread());
    }

    #onUp(event) {
        const finger = this.#fingerOf(event);
        finger.isTurning = false;
        this.interaction.release(finger.pointer, performance.now());
        if (event.pointerType !== "mouse") this.#fingers.delete(event.pointerId);
    }

    #forget(event) {
        const finger = this.#fingers.get(event.pointerId);
        if (finger && !finger.pointer.isPressed) this.#fingers.delete(event.pointerId);
    }

    #onWheel(event) {
        event.preventDefault();
        this.#isMoved = true;
        this.#wanted = null;
        this.#zoom(Math.exp(event.deltaY * 0.001));
    }

    // Between two fingers, px; 0 with other numbers of them.
    #spread() {
        const [a, b, more] = [...this.#fingers.values()].filter((one) => one.isTurning);
        return b && !more ? Math.hypot(a.x - b.x, a.y - b.y) : 0;
    }

    #turn(dx, dy) {
        this.#yaw -= dx * PER_PIXEL;
        this.#pitch = Math.min(Math.max(this.#pitch + dy * PER_PIXEL, 0.05), 1.5);
    }

    #shift(dx, dy) {
        const perPixel = this.#distance / this.canvas.clientHeight;
        const T = this.T_map_camera;
        const length = Math.hypot(T[8], T[9]) || 1;
        for (let i = 0; i < 2; i++) this.#target[i] += perPixel * (-dx * T[i] - (dy * T[8 + i]) / length);
    }

    #zoom(factor) {
        this.#distance = Math.min(Math.max(this.#distance * factor, NEAREST_M), FARTHEST_M);
    }
}
