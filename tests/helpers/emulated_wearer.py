"""A wearer of an emulated headset: how it moves, in the browser and as its device's poses in the map."""

from __future__ import annotations

import time

import numpy as np
from helpers.browser import Browser, BrowserPage, emulator
from helpers.headset_room import CODE, Pose

from share.geometry import se3
from share.types import F64

# Where the headset's space is in the map: turned, with the floor 1.62 m below the map's origin.
_WEBXR_WORLD = np.array([[0.0, -1, 0], [0, 0, 1], [-1, 0, 0]])
T_map_local = se3.from_rt(
    se3.so3_exp(np.array([0.0, 0.0, 0.7])) @ _WEBXR_WORLD.T, np.array([1.5, -0.8, -1.62])
)
T_body_viewer = se3.from_rt(
    se3.so3_exp(np.array([0.03, -0.02, 0.01])) @ np.diag([1.0, -1, -1]), np.array([0.012, 0.06, -0.03])
)

# Walks and looks around by the wall clock; still before `walks`. All but the space itself is in the room:
# a recentred space (`space`: turned by yaw, then shifted) moves what the headset reports.
_SCRIPT = """
    window.space = { yaw: 0, x: 0, z: 0 };
    window.walks = false;
    window.aims = { at: [0.6, 0, -1.4], from: [0.2, 1.3, -0.3] };  // of the right hand
    window.drags = null;  // moves the aim
    const set = (one, [x, y, z], yaw, pitch) => {
        const { space } = window;
        const [s, c] = [Math.sin(space.yaw), Math.cos(space.yaw)];
        one.position.set(c * x + s * z + space.x, y, -s * x + c * z + space.z);
        const [a, b] = [(yaw + space.yaw) / 2, pitch / 2];
        const [sa, ca, sb, cb] = [Math.sin(a), Math.cos(a), Math.sin(b), Math.cos(b)];
        one.quaternion.set(ca * sb, sa * cb, -sa * sb, ca * cb);
    };
    window.unspaced = ([x, y, z]) => {
        const { space } = window;
        const [s, c] = [Math.sin(space.yaw), Math.cos(space.yaw)];
        return [c * (x - space.x) - s * (z - space.z), y, s * (x - space.x) + c * (z - space.z)];
    };
    window.aimed = (hand, { at, from }) => {
        const d = [0, 1, 2].map((i) => at[i] - from[i]);
        set(hand, from, Math.atan2(-d[0], -d[2]), Math.asin(d[1] / Math.hypot(...d)));
    };
    window.move = (wallMs) => {
        const t = window.walks ? (wallMs / 1000) % 1000 : 0;
        const p = [0.5 * Math.sin(0.9 * t), 1.6 + 0.04 * Math.sin(2.1 * t), 0.5 * Math.sin(0.7 * t)];
        set(headset, p, 0.6 * Math.sin(1.1 * t), 0.3 * Math.sin(1.3 * t));
        window.drags?.(wallMs);
        const hand = headset.primaryInputMode === "hand" ? headset.hands.right : headset.controllers.right;
        window.aimed(hand, window.aims);
    };
"""


def viewer_pose(wall_s: float, walks: bool) -> F64:
    """Return T_local_viewer (4, 4), as the script has it, in the space that was never recentred."""
    t = wall_s % 1000 if walks else 0.0
    p = np.array([0.5 * np.sin(0.9 * t), 1.6 + 0.04 * np.sin(2.1 * t), 0.5 * np.sin(0.7 * t)])
    yaw, pitch = 0.6 * np.sin(1.1 * t), 0.3 * np.sin(1.3 * t)
    R = se3.so3_exp(np.array([0, yaw, 0])) @ se3.so3_exp(np.array([pitch, 0, 0]))
    return se3.from_rt(R, p)


class Walk:
    """Poses of the device on the head."""

    walks = False

    def __init__(self, mount: F64 = T_body_viewer) -> None:
        self._mount = mount

    def __call__(self, wall_s: float) -> Pose:
        def pose(at_s: float) -> F64:
            return T_map_local @ viewer_pose(at_s, self.walks) @ se3.inverse(self._mount)

        step_s = 0.01
        T, before, after = (pose(wall_s + shift) for shift in (0.0, -step_s, step_s))
        velocity = (after[:3, 3] - before[:3, 3]) / (2 * step_s)
        turning = se3.so3_log(before[:3, :3].T @ after[:3, :3]) / (2 * step_s)
        return T, velocity, turning


def pair(page: BrowserPage, name: str, agent: str = "", code: str = CODE) -> None:
    """Fill the form in and send it, as a person does."""
    for field, text in (("#code", code), ("#name", name), ("#agent", agent)):
        page.evaluate(f"document.querySelector({field!r}).value = ''")
        if text:
            page.type(field, text)
    page.click("#pairing button")


def wear(
    browser: Browser,
    url: str,
    name: str,
    code: str = CODE,
    size: tuple[int, int] = (480, 240),
    max_hz: float | None = None,
) -> BrowserPage:
    """Open the page in an emulated headset, pair as wearer and agent `name`, and enter."""
    page = browser.page(url, *size, emulator(), max_hz)
    page.evaluate(f"(() => {{{_SCRIPT}}})()")
    pair(page, name, name, code)
    enter(page)
    return page


def enter(page: BrowserPage) -> None:
    """Enter AR once the page is connected."""
    page.wait("app.connection.isConnected && app.connection.clock.isKnown")
    page.click("#enter")
    page.wait("app.isInHeadset && app.frames > 20")


def open_again(page: BrowserPage, url: str) -> None:
    """Load the page again, in the same headset."""
    page.open(url)
    page.evaluate(f"(() => {{{_SCRIPT}}})()")
    enter(page)


def walk_aligned(page: BrowserPage) -> None:
    """Walk about until what is drawn stays in its place."""
    page.evaluate("walks = true")
    page.wait("app.place.mapId !== null && app.alignmentMm !== null")
    end = time.monotonic() + 60.0  # on a busy machine the page learns the server's clock slowly
    while (error_m := np.median([drawn_error(page)[0] for _ in range(20)])) > 0.01:
        assert time.monotonic() < end, error_m


def wait_until_said(page: BrowserPage, text: str, seconds: float = 60.0) -> None:
    """Wait until the panel says so."""
    end = time.monotonic() + seconds
    while True:
        lines = [line for line, _ in page.app("app.lines")]
        if any(text in line for line in lines):
            return
        assert time.monotonic() < end, lines
        time.sleep(0.05)


def drawn_error(page: BrowserPage, room_space: F64 | None = None) -> tuple[float, float]:
    """Return how far from its place the wearer draws itself, m and rad. room_space (4, 4): from the present
    space to the one before recentring."""
    values = page.app("[[...app.placement.T_map_local], [...app.viewerPose]]")
    drawn, viewer = (np.reshape(one, (4, 4), order="F") for one in values)
    truth = T_map_local if room_space is None else T_map_local @ room_space
    error = se3.log(se3.inverse(truth @ viewer) @ drawn @ viewer)
    return float(np.linalg.norm(error[3:])), float(np.linalg.norm(error[:3]))


def press(page: BrowserPage, is_pressed: bool, hand: bool = False) -> None:
    """Pull the trigger of the right controller, or pinch; or let go."""
    value = int(is_pressed)
    what = (
        f"hands.right.updatePinchValue({value})"
        if hand
        else f"controllers.right.updateButtonValue('trigger', {value})"
    )
    page.evaluate(f"headset.{what}")
    wait_frames(page, 3)


def wait_frames(page: BrowserPage, count: int) -> None:
    page.wait(f"app.frames >= {page.app('app.frames') + count}")


def aim(page: BrowserPage, button: str) -> None:
    """Point at a button of the panel, which follows who walks."""
    for _ in range(100):
        page.app(f"(aims = {{ ...aims, at: unspaced(app.panel.centreOf({button!r})) }}, 0)")
        wait_frames(page, 2)
        if page.app("app.panel.hovered?.name") == button:
            return
    raise AssertionError(f"the button {button} cannot be pushed")


def push(page: BrowserPage, button: str) -> None:
    """Point at a button of the panel and press it."""
    aim(page, button)
    press(page, True)
    press(page, False)


def stand(page: BrowserPage) -> None:
    """End the walk, with the panel before the wearer, where no ray to the floor meets it."""
    page.app("(walks = false, app.panel.forget(), 0)")
    wait_frames(page, 3)


def place(page: BrowserPage, what: str) -> None:
    """Pull the trigger until a cube or marker is there: a panel that followed may be in the way."""
    page.app(f"(app.interaction.armed = {what!r}, 0)")
    for _ in range(100):
        press(page, True)
        if page.app("app.interaction.armed === null"):
            return
        press(page, False)
    raise AssertionError(f"no {what} was placed")


def drag_marker(page: BrowserPage, seconds: float) -> None:
    """Place a marker by the panel and drag it along the floor for so long, 1.3 m."""
    push(page, "marker")
    page.evaluate("aims = { ...aims, at: [0.6, 0, -1.4] }, 0")
    wait_frames(page, 3)
    place(page, "marker")
    page.evaluate(
        "(began = performance.now(), drags = () => {"
        f" const s = Math.min((performance.now() - began) / {1000 * seconds}, 1);"
        " aims = { ...aims, at: [0.6 - s, 0, -1.4 - 0.8 * s] }; }, 0)"
    )
    time.sleep(seconds)
    page.evaluate("drags = null")
    wait_frames(page, 2)
    press(page, False)


# Notes when a marker is drawn where, ms of the wall clock.
SEEN = """(seen = [], () => {
    frameTimes = [];
    const note = () => {
        requestAnimationFrame(note);
        frameTimes.push(performance.now());
        const one = [...app.room.objects.values()].find((one) => one.kind === "marker");
        if (one) seen.push([performance.timeOrigin + performance.now(), one.shown[12], one.shown[13]]);
    };
    requestAnimationFrame(note);
})()"""


def lateness_ms(first: BrowserPage, second: BrowserPage) -> F64:
    """Return how much later than the first page the second drew what both have drawn, ms, by `SEEN`."""
    drawn, seen = ({} for _ in range(2))
    for times, page in ((drawn, first), (seen, second)):
        for at_ms, x, y in page.evaluate("seen"):
            times.setdefault((round(x, 4), round(y, 4)), at_ms)
    return np.array([at_ms - drawn[place] for place, at_ms in seen.items() if place in drawn])


def frame_ms(page: BrowserPage) -> float:
    """Return the time between two frames of a page, median, ms, by `SEEN`."""
    return float(np.median(np.diff(page.evaluate("frameTimes"))))


# Notes where each object is drawn in the room, by the headset's own space, which `space` says the shift of.
WATCH = """(async () => {
    const { inverse, identity, transformPoint } = await import("/math.js");
    const { app } = await import("/main.js");
    watched = {};
    const note = () => {
        requestAnimationFrame(note);
        if (app.place.mapId === null) return;
        const T_local_map = inverse(identity(), app.place.T_map_local);
        for (const [id, one] of app.room.objects) {
            const p = [...transformPoint([0, 0, 0], T_local_map, one.shown.subarray(12, 15))];
            (watched[id] ??= []).push(unspaced(p));
        }
    };
    requestAnimationFrame(note);
})()"""


def moved_m(page: BrowserPage, object_id: int) -> tuple[float, float]:
    """Return how far at most an object was drawn from where it was first, and how far it moved between two
    frames, by `WATCH`; then begin anew."""
    drawn = np.array(page.evaluate(f"watched[{object_id}]"))
    page.evaluate("(watched = {}, 0)")
    steps = np.linalg.norm(np.diff(drawn, axis=0), axis=1)
    return float(np.linalg.norm(drawn - np.median(drawn[:5], axis=0), axis=1).max()), float(steps.max())
