// Draws shapes on WebGL2: solids, wide lines, points, and pictures of text. Blends premultiplied, over what the headset
// sees through its cameras or over the page's background. A frame makes nothing anew, and sets no state that is set.
import { LINES, SOLIDS } from "./geometry.js";

const WHITE = [1, 1, 1];
const HEADER = "#version 300 es\nprecision highp float;\n";
const COMMON = `${HEADER}uniform mat4 viewProjection, model; uniform vec4 colour;`;

const SOLID = [
    `${COMMON} layout(location=0) in vec3 position; layout(location=1) in vec3 normal; out float shade;
    void main() {
        shade = 0.68 + 0.32 * dot(normalize(mat3(model) * normal), vec3(0.36, 0.28, 0.89));
        gl_Position = viewProjection * model * vec4(position, 1.0);
    }`,
    `${HEADER}uniform vec4 colour; in float shade; out vec4 pixel;
    void main() { pixel = vec4(colour.rgb * shade * colour.a, colour.a); }`,
];
// A segment is a quad, as wide in pixels everywhere; what is behind the eye is cut off first.
const LINE = [
    `${COMMON} uniform vec2 size; uniform float width, fade;
    layout(location=0) in vec3 a; layout(location=1) in vec3 b; out float distance;
    void main() {
        vec4 p = viewProjection * model * vec4(a, 1.0), q = viewProjection * model * vec4(b, 1.0);
        const float near = 0.02;
        if (p.w < near && q.w > near) p = mix(p, q, (near - p.w) / (q.w - p.w));
        if (q.w < near && p.w > near) q = mix(q, p, (near - q.w) / (p.w - q.w));
        vec2 along = normalize((q.xy / q.w - p.xy / p.w) * size + vec2(1e-6, 0.0));
        vec4 end = gl_VertexID < 2 ? p : q;
        float side = (gl_VertexID & 1) == 0 ? -1.0 : 1.0;
        distance = fade > 0.0 ? end.w / fade : 0.0;
        gl_Position = end + vec4(vec2(-along.y, along.x) * side * width / size * end.w, 0.0, 0.0);
    }`,
    `${HEADER}uniform vec4 colour; in float distance; out vec4 pixel;
    void main() { float a = colour.a * clamp(1.0 - distance, 0.0, 1.0); pixel = vec4(colour.rgb * a, a); }`,
];
const POINT = [
    `${COMMON} uniform float width; layout(location=0) in vec3 position;
    void main() {
        gl_Position = viewProjection * model * vec4(position, 1.0);
        gl_PointSize = clamp(width / gl_Position.w, 1.5, 8.0);
    }`,
    `${HEADER}uniform vec4 colour; out vec4 pixel;
    void main() {
        if (length(gl_PointCoord - 0.5) > 0.5) discard;
        pixel = vec4(colour.rgb * colour.a, colour.a);
    }`,
];
// A picture, on a rectangle of one by one about the model's origin.
const PICTURE = [
    `${COMMON} out vec2 uv;
    void main() {
        vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1);
        uv = vec2(corner.x, 1.0 - corner.y);
        gl_Position = viewProjection * model * vec4(corner - 0.5, 0.0, 1.0);
    }`,
    `${HEADER}uniform sampler2D picture; uniform vec4 colour; in vec2 uv; out vec4 pixel;
    void main() { pixel = texture(picture, uv) * colour.a; }`,
];

export class Renderer {
    #view = 0;  // how many were begun
    #used = null;  // program
    #bound = null;  // array
    #hides = true;  // what is drawn, what comes behind it
    #isHidden = true;  // what is drawn, behind what is there

    constructor(canvas) {
        const gl = canvas.getContext("webgl2", { alpha: true, antialias: true, xrCompatible: true });
        if (gl === null) throw new Error("this browser has no WebGL2");
        this.gl = gl;
        this.solid = this.#program(SOLID);
        this.line = this.#program(LINE);
        this.point = this.#program(POINT);
        this.picture = this.#program(PICTURE);
        this.solids = Object.fromEntries(Object.entries(SOLIDS).map(([name, data]) => [name, this.#solidOf(data)]));
        this.lines = Object.fromEntries(
            Object.entries(LINES).map(([name, data]) => [name, this.setLines(null, new Float32Array(data))]),
        );
        this.noArray = gl.createVertexArray();  // of pictures, whose corners are counted
        this.viewProjection = new Float32Array(16);
        this.size = new Float32Array(2);
        gl.enable(gl.BLEND);
        gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    }

    // Begin a frame, on the screen where framebuffer is null. What others left set is not relied on.
    beginFrame(framebuffer) {
        const gl = this.gl;
        gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
        this.#used = this.#bound = null;
        gl.enable(gl.DEPTH_TEST);
        gl.depthMask(true);  // else its depths are not cleared
        this.#hides = this.#isHidden = true;
        gl.clearColor(0, 0, 0, 0);
        gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    }

    // Begin one eye's picture, or the whole one.
    beginView(x, y, width, height, viewProjection) {
        this.#view++;
        this.gl.viewport(x, y, width, height);
        this.size[0] = width;
        this.size[1] = height;
        this.viewProjection.set(viewProjection);
    }

    drawSolid(name, model, colour, alpha = 1) {
        const { array, count } = this.solids[name];
        this.#use(this.solid, model, colour, alpha);
        this.#draw(array, this.gl.TRIANGLES, count, 0, alpha >= 1);
    }

    // width px; fade: the distance at which they have vanished, m.
    drawLines(shape, model, colour, alpha = 1, width = 2, fade = 0) {
        const { array, count } = typeof shape === "string" ? this.lines[shape] : shape;
        if (count === 0) return;
        this.#use(this.line, model, colour, alpha);
        const { at, wide } = this.line;
        if (wide.view !== this.#view) this.gl.uniform2fv(at.size, this.size);
        wide.view = this.#view;
        if (wide.width !== width) this.gl.uniform1f(at.width, (wide.width = width));
        if (wide.fade !== fade) this.gl.uniform1f(at.fade, (wide.fade = fade));
        this.#draw(array, this.gl.TRIANGLE_STRIP, 4, count, alpha >= 1);
    }

    drawPoints({ array, count }, model, colour, alpha = 1) {
        if (count === 0) return;
        this.#use(this.point, model, colour, alpha);
        this.gl.uniform1f(this.point.at.width, 0.006 * this.size[1]);  // 12 mm at a field of view of 90 degrees
        this.#draw(array, this.gl.POINTS, count, 0, alpha >= 1);
    }

    drawPicture(texture, model, alpha = 1, isInFront = false) {
        const gl = this.gl;
        this.#use(this.picture, model, WHITE, alpha);
        gl.bindTexture(gl.TEXTURE_2D, texture);
        this.#draw(this.noArray, gl.TRIANGLE_STRIP, 4, 0, false, isInFront);
    }

    // Segments [ax ay az bx by bz ..] on the card: a new buffer, or the one that `lines` had.
    setLines(lines, data) {
        const gl = this.gl;
        lines ??= { array: gl.createVertexArray(), buffer: gl.createBuffer(), count: 0 };
        gl.bindVertexArray((this.#bound = lines.array));
        gl.bindBuffer(gl.ARRAY_BUFFER, lines.buffer);
        gl.bufferData(gl.ARRAY_BUFFER, data, gl.DYNAMIC_DRAW);
        for (const k of [0, 1]) {
            gl.enableVertexAttribArray(k);
            gl.vertexAttribPointer(k, 3, gl.FLOAT, false, 24, 12 * k);
            gl.vertexAttribDivisor(k, 1);
        }
        lines.count = data.length / 6;
        return lines;
    }

    // Joined corners [x y z ..]; likewise.
    setPath(lines, corners) {
        lines = this.setLines(lines, corners);
        for (const k of [0, 1]) this.gl.vertexAttribPointer(k, 3, this.gl.FLOAT, false, 12, 12 * k);
        lines.count = Math.max(corners.length / 3 - 1, 0);
        return lines;
    }

    setPoints(points, data, count) {
        const gl = this.gl;
        points ??= { array: gl.createVertexArray(), buffer: gl.createBuffer(), count: 0 };
        gl.bindVertexArray((this.#bound = points.array));
        gl.bindBuffer(gl.ARRAY_BUFFER, points.buffer);
        gl.bufferData(gl.ARRAY_BUFFER, data.subarray(0, 3 * count), gl.STATIC_DRAW);
        gl.enableVertexAttribArray(0);
        gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 12, 0);
        points.count = count;
        return points;
    }

    // What a 2D canvas shows, as a texture: a new one, or over the old one.
    setPicture(texture, canvas) {
        const gl = this.gl;
        const isNew = texture === null;
        texture ??= gl.createTexture();
        gl.bindTexture(gl.TEXTURE_2D, texture);
        gl.pixelStorei(gl.UNPACK_PREMULTIPLY_ALPHA_WEBGL, true);
        gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, canvas);
        gl.generateMipmap(gl.TEXTURE_2D);
        if (!isNew) return texture;
        gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR_MIPMAP_LINEAR);
        gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
        gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
        return texture;
    }

    forgetPicture(texture) {
        this.gl.deleteTexture(texture);
    }

    #use(program, model, colour, alpha) {
        const gl = this.gl;
        if (this.#used !== program) gl.useProgram(program.program);
        this.#used = program;
        if (program.view !== this.#view) gl.uniformMatrix4fv(program.at.viewProjection, false, this.viewProjection);
        program.view = this.#view;
        gl.uniformMatrix4fv(program.at.model, false, model);
        gl.uniform4f(program.at.colour, colour[0], colour[1], colour[2], alpha);
    }

    // hides: what one sees through hides nothing behind it.
    #draw(array, mode, count, instances, hides, isInFront = false) {
        const gl = this.gl;
        if (this.#hides !== hides) gl.depthMask((this.#hides = hides));
        if (this.#isHidden === isInFront) {
            this.#isHidden = !isInFront;
            if (isInFront) gl.disable(gl.DEPTH_TEST);
            else gl.enable(gl.DEPTH_TEST);
        }
        if (this.#bound !== array) gl.bindVertexArray((this.#bound = array));
        if (instances > 0) gl.drawArraysInstanced(mode, 0, count, instances);
        else gl.drawArrays(mode, 0, count);
    }

    #solidOf(data) {
        const gl = this.gl;
        const array = gl.createVertexArray();
        gl.bindVertexArray(array);
        gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
        gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
        for (const k of [0, 1]) {
            gl.enableVertexAttribArray(k);
            gl.vertexAttribPointer(k, 3, gl.FLOAT, false, 24, 12 * k);
        }
        return { array, count: data.length / 6 };
    }

    #program(sources) {
        const gl = this.gl;
        const program = gl.createProgram();
        [gl.VERTEX_SHADER, gl.FRAGMENT_SHADER].forEach((kind, k) => {
            const shader = gl.createShader(kind);
            gl.shaderSource(shader, sources[k]);
            gl.compileShader(shader);
            gl.attachShader(program, shader);
        });
        gl.linkProgram(program);
        if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
        const names = ["viewProjection", "model", "colour", "size", "width", "fade"];
        const at = Object.fromEntries(names.map((name) => [name, gl.getUniformLocation(program, name)]));
        return { program, at, view: 0, wide: { view: 0, width: null, fade: null } };  // as set last
    }
}
