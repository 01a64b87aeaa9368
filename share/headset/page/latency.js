// How long after its stamp a pose was drawn: the page's share of motion-to-photon, percentiles of a short while.

export const TARGET_MS = 20;
const MOST = 512;  // frames between two summaries: 2 s at 120 Hz and then some

export class Latency {
    #values = new Float64Array(MOST);
    #count = 0;
    #over = 0;
    summary = null;  // of the last while that had frames

    add(ms) {
        this.#values[this.#count % MOST] = ms;
        this.#count++;
        this.#over += ms > TARGET_MS;
    }

    // Begin anew, and return {frames, over_20ms, p50_ms, p95_ms, p99_ms}; null without frames.
    take() {
        const frames = this.#count;
        if (frames === 0) return null;
        const sorted = this.#values.subarray(0, Math.min(frames, MOST)).sort();
        const at = (share) => sorted[Math.ceil(share * sorted.length) - 1];
        this.summary = { frames, over_20ms: this.#over, p50_ms: at(0.5), p95_ms: at(0.95), p99_ms: at(0.99) };
        this.#count = this.#over = 0;
        return this.summary;
    }
}
