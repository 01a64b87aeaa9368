// Pictures of short texts, made once each: names are drawn as text and read as nothing else.

const MOST = 128;
const SIZE_PX = 44;
const FONT = `600 ${SIZE_PX}px system-ui, sans-serif`;

export class Labels {
    #pictures = new Map();  // by text: {texture, aspect}
    #canvas = document.createElement("canvas");

    constructor(renderer) {
        this.renderer = renderer;
    }

    of(text) {
        return this.#pictures.get(text) ?? this.#make(text);
    }

    #make(text) {
        if (this.#pictures.size >= MOST) {
            const [oldest, { texture }] = this.#pictures.entries().next().value;
            this.renderer.forgetPicture(texture);
            this.#pictures.delete(oldest);
        }
        const canvas = this.#canvas;
        const context = canvas.getContext("2d");
        context.font = FONT;
        canvas.width = Math.min(Math.ceil(context.measureText(text).width) + SIZE_PX, 1024);
        canvas.height = Math.ceil(1.6 * SIZE_PX);
        context.font = FONT;  // a new width forgets it
        context.fillStyle = "rgba(10, 14, 20, 0.72)";
        context.beginPath();
        context.roundRect(0, 0, canvas.width, canvas.height, canvas.height / 2);
        context.fill();
        context.fillStyle = "#fff";
        context.textAlign = "center";
        context.textBaseline = "middle";
        context.fillText(text, canvas.width / 2, canvas.height / 2 + 2, canvas.width - SIZE_PX / 2);
        const picture = { texture: this.renderer.setPicture(null, canvas), aspect: canvas.width / canvas.height };
        this.#pictures.set(text, picture);
        return picture;
    }
}
