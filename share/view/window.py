"""The page: draws in a browser by viser, which keeps for each browser only what it has not drawn yet."""

from __future__ import annotations

import asyncio
import socket
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import wraps
from typing import Any, Concatenate, ParamSpec

import numpy as np

from share.colours import Colour
from share.geometry.se3 import quat_from_matrix
from share.net.http_guard import HttpGuard
from share.types import F64, AgentKind
from share.view import drawing as dr
from share.view.guarded_server import guarded_serving, remove_tunnel
from share.view.loop_views import LoopViews, shrunk

_GREY = (110, 110, 110)
_POINT_M = 0.03
_FRUSTUM_SIZE = 0.5
_ROBOT_RADIUS_M, _ROBOT_HEIGHT_M = 0.17, 0.2  # a TurtleBot 4
_PICTURE_PX = 160  # width
_ORBIT, _ABOVE, _FOLLOW = "orbit", "from above", "follow "
_SEEN_SHARE = 0.7  # distance of the camera, in diagonals of the room
_MARK_M = 0.07  # radius
_MARK = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]]) * _MARK_M
_MARK_FACES = np.array([[i, j, k] for i, j in ((0, 2), (2, 1), (1, 3), (3, 0)) for k in (4, 5)])
_MAX_CLICKS = 16  # that wait
_PORTRAIT = 1.3  # height by width from which the panel lies below, over three fifths of the window
_ABOVE_PANEL = 0.5  # of half a window's height: what is looked at then stands so far above its middle
_Given = ParamSpec("_Given")
_START = (np.array([-3.0, -4.0, 3.0]), np.array([0.0, 0.0, 0.0]))


@dataclass(frozen=True, eq=False)
class Click:
    """A click into the scene: the browser, and its ray, origin (3,) and direction (3,)."""

    browser: int
    origin: F64
    direction: F64


def _in_thread_of_viser(
    method: Callable[Concatenate[Window, _Given], None],
) -> Callable[Concatenate[Window, _Given], None]:
    """Call a method there, and wait: viser's queues wake readers by events that only that thread may set."""

    @wraps(method)
    def call(window: Window, /, *args: _Given.args, **more: _Given.kwargs) -> None:
        async def act() -> None:
            method(window, *args, **more)

        asyncio.run_coroutine_threadsafe(act(), window._server.get_event_loop()).result()

    return call


class Window:
    """Serves the page on a listening socket. Methods are called from one thread."""

    def __init__(self, listener: socket.socket, guard: HttpGuard, title: str) -> None:
        with guarded_serving(listener, guard):
            import viser

            self._server = viser.ViserServer(verbose=False, label=title)
        remove_tunnel(self._server)
        self._server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        self._server.scene.set_up_direction("+z")
        self._panel = self._server.gui.add_html("")
        self._panel_html = ""
        self._frames: dict[str, Any] = {}  # nodes of bodies by name, with the colour that they were drawn in
        self._colours: dict[str, tuple[Colour, str]] = {}
        self._cameras: dict[int, _BrowserCamera] = {}
        self._clicks: deque[Click] = deque(maxlen=_MAX_CLICKS)
        self._followed: tuple[str, ...] = ()
        self._floor: dr.FloorGrid | None = None
        self._has_served = True
        self._server.on_client_connect(self._open)
        self._server.on_client_disconnect(self._close)

    async def _open(self, client: Any) -> None:
        """Called by viser in its thread, as every coroutine."""
        camera = _BrowserCamera(client, self._followed)
        camera.look_at_room(self._floor)
        self._cameras[client.client_id] = camera

    async def _close(self, client: Any) -> None:
        self._cameras.pop(client.client_id, None)

    def stop(self) -> None:
        self._server.stop()

    def is_watched(self) -> bool:
        """Return whether any browser is connected."""
        return bool(self._server._websock_server._live_connections)

    def has_served(self) -> bool:
        """Return whether the thread that serves the browsers has run since the last call."""
        has_served, self._has_served = self._has_served, False
        self._server.get_event_loop().call_soon_threadsafe(self._note_served)
        return has_served

    def _note_served(self) -> None:
        """Called by viser's thread."""
        self._has_served = True

    # ------------------------------------------------------------------ drawing

    @_in_thread_of_viser
    def draw(self, drawings: Sequence[dr.Drawing]) -> None:
        """Draw what has changed, all at once."""
        with self._server.atomic():
            for one in drawings:
                self._draw(one)

    def _draw(self, one: dr.Drawing) -> None:
        scene = self._server.scene
        match one:
            case dr.Points():
                scene.add_point_cloud(
                    one.name,
                    one.points,
                    one.colour,
                    point_size=_POINT_M,
                    position=one.origin,
                    point_shape="circle",
                )
            case dr.Lines():
                scene.add_line_segments(
                    one.name,
                    one.segments,
                    one.colour,
                    thickness=one.width,
                    thickness_units="screen",
                    position=one.origin,
                )
            case dr.Marks():
                self._draw_marks(one)
            case dr.AgentBody():
                self._draw_body(one)
            case dr.Picture():
                self._draw_picture(one)
            case dr.Text():
                scene.add_label(one.name, one.text, position=one.position, font_screen_scale=1.3)
            case dr.FloorGrid():
                self._draw_floor(one)
            case dr.RemoveDrawing():
                self._frames.pop(one.name, None)
                self._colours.pop(one.name, None)
                self._server.scene.remove_by_name(one.name)
            case dr.Announcement():
                for client in self._server.get_clients().values():
                    client.add_notification(one.title, one.text, auto_close_seconds=dr.ANNOUNCED_S)

    def _draw_marks(self, marks: dr.Marks) -> None:
        upright = np.tile((1.0, 0.0, 0.0, 0.0), (len(marks.positions), 1))
        handle = self._server.scene.add_batched_meshes_simple(
            marks.name,
            _MARK.astype(np.float32),
            _MARK_FACES.astype(np.uint32),
            batched_wxyzs=upright,
            batched_positions=marks.positions,
            batched_colors=marks.colour,
            side="double",
            cast_shadow=False,
        )
        handle.on_click(self._take_click)

    async def _take_click(self, event: Any) -> None:
        origin, direction = (np.array(one, np.float64) for one in (event.ray_origin, event.ray_direction))
        self._clicks.append(Click(event.client_id, origin, direction))

    def take_clicks(self) -> list[Click]:
        """Return the clicks since the last call."""
        return [self._clicks.popleft() for _ in range(len(self._clicks))]

    @_in_thread_of_viser
    def show_views(self, browser: int, views: LoopViews) -> None:
        """Show what the keyframes of a loop saw, in one browser."""
        if (client := self._server.get_clients().get(browser)) is None:
            return
        modal = client.gui.add_modal("loop")

        async def close(_event: Any) -> None:
            modal.close()

        with modal:
            client.gui.add_html(views.html())
            client.gui.add_button("close").on_click(close)

    def _draw_body(self, body: dr.AgentBody) -> None:
        colour = body.colour if body.is_current else _GREY
        if self._colours.get(body.name) != (colour, body.label):
            self._make_body(body, colour)
        upright, camera = self._frames[body.name]
        upright.position, upright.wxyz = (
            body.T_room_body[:3, 3],
            _wxyz(_upright(body.T_room_body, body.T_body_cam0)),
        )
        camera.position, camera.wxyz = body.T_room_body[:3, 3], _wxyz(body.T_room_body[:3, :3])

    def _make_body(self, body: dr.AgentBody, colour: Colour) -> None:
        scene, name = self._server.scene, body.name
        self._colours[name] = colour, body.label
        scene.add_frame(name, show_axes=False)
        upright = scene.add_frame(f"{name}/upright", show_axes=False)
        camera = scene.add_frame(f"{name}/tilted", show_axes=False)
        self._frames[name] = upright, camera
        text = body.label if body.is_current else f"{body.label} (no current pose)"
        scene.add_label(f"{name}/upright/label", text, position=(0.0, 0.0, 0.25), anchor="bottom-center")
        if body.kind is AgentKind.ROBOT:
            scene.add_cylinder(
                f"{name}/upright/robot",
                radius=_ROBOT_RADIUS_M,
                height=_ROBOT_HEIGHT_M,
                color=colour,
                position=(0.0, 0.0, -_ROBOT_HEIGHT_M / 2),
            )
        horizontal, vertical = body.half_angles
        scene.add_camera_frustum(
            f"{name}/tilted/camera",
            fov=float(2 * np.arctan(vertical)),
            aspect=horizontal / vertical,
            scale=_FRUSTUM_SIZE if body.kind is AgentKind.AR else 0.6 * _FRUSTUM_SIZE,
            color=colour,
            thickness=0.012,
            position=body.T_body_cam0[:3, 3],
            wxyz=_wxyz(body.T_body_cam0[:3, :3]),
        )

    def _draw_picture(self, picture: dr.Picture) -> None:
        handle = self._server.scene.get_handle_by_name(f"{picture.name}/tilted/camera")
        if handle is not None and (image := _small_picture(picture.jpeg)) is not None:
            handle.image = image

    def _draw_floor(self, floor: dr.FloorGrid) -> None:
        self._floor = floor
        (x0, y0), (x1, y1) = floor.low, floor.high
        self._server.scene.add_grid(
            "/floor",
            width=x1 - x0,
            height=y1 - y0,
            cell_size=1.0,
            section_size=5.0,
            cell_color=(60, 60, 66),
            section_color=(90, 90, 98),
            position=((x0 + x1) / 2, (y0 + y1) / 2, floor.z),
        )
        self._for_each_camera(lambda camera: camera.look_at_room(floor))

    # ------------------------------------------------------------------ panel and cameras

    @_in_thread_of_viser
    def show_panel(self, html: str, agents: Sequence[str]) -> None:
        """Show the side panel. agents: names that can be followed."""
        if html != self._panel_html:
            self._panel_html = self._panel.content = html
        self._followed = tuple(agents)
        self._for_each_camera(lambda camera: camera.offer(self._followed))

    @_in_thread_of_viser
    def follow(self, place: Callable[[str], F64 | None]) -> None:
        """Move the cameras that follow an agent. place: T_room_body (4, 4) of an agent by name."""
        self._for_each_camera(lambda camera: camera.follow(place))

    def _for_each_camera(self, act: Callable[[_BrowserCamera], None]) -> None:
        for browser, camera in list(self._cameras.items()):
            with self.disconnect_on_failure(browser):
                act(camera)

    @contextmanager
    def disconnect_on_failure(self, browser: int) -> Iterator[None]:
        """Disconnect a browser if what is done for it fails: it has sent something odd, or just left."""
        try:
            yield
        except Exception:
            self._cameras.pop(browser, None)
            served = self._server._websock_server
            if (connection := served._live_connections.get(browser)) is not None:
                self._server.get_event_loop().call_soon_threadsafe(connection.transport.abort)


class _BrowserCamera:
    """The camera of one browser, and how its user moves it."""

    def __init__(self, client: Any, agents: tuple[str, ...]) -> None:
        self._client = client
        self._agents = agents
        self._choice = client.gui.add_dropdown("camera", _choices(agents), initial_value=_ORBIT, order=-1.0)
        self._choice.on_update(self._take_choice)
        self._floor: dr.FloorGrid | None = None
        self._set_position: F64 | None = None  # that this program chose last
        self._last: F64 | None = None  # of the agent that is followed

    async def _take_choice(self, _event: Any) -> None:
        self._choose()

    def offer(self, agents: tuple[str, ...]) -> None:
        if agents != self._agents:
            self._agents, chosen = agents, self._choice.value
            self._choice.options = _choices(agents)
            self._choice.value = chosen if chosen in _choices(agents) else _ORBIT

    def look_at_room(self, floor: dr.FloorGrid | None) -> None:
        """Show all of the room, unless its user has moved the camera."""
        self._floor = floor
        is_own = self._set_position is None or bool(
            np.linalg.norm(self._client.camera.position - self._set_position) < 0.05
        )
        if is_own and self._choice.value == _ORBIT:
            self._show_room()
        elif self._choice.value == _ABOVE:
            self._choose()

    def _show_room(self) -> None:
        if self._floor is None:
            self._look(*_START)
            return
        centre, size = _extent(self._floor)
        self._look(centre + self._distance(size) * np.array([-0.45, -0.6, 0.55]), centre)

    def _distance(self, size: float) -> float:
        """Return how far the camera is from a room of this diagonal; further in a narrow window."""
        camera = self._client.camera
        narrowness = float(camera.image_height / max(1, camera.image_width))
        return _SEEN_SHARE * size * min(2.0, max(1.0, narrowness))

    def _choose(self) -> None:
        self._last = None
        if self._choice.value == _ABOVE and self._floor is not None:
            centre, size = _extent(self._floor)
            self._look(centre + np.array([0.0, -0.01, self._distance(size)]), centre)
        elif self._choice.value == _ORBIT:
            self._show_room()

    def follow(self, place: Callable[[str], F64 | None]) -> None:
        chosen = self._choice.value
        if not chosen.startswith(_FOLLOW) or (T := place(chosen.removeprefix(_FOLLOW))) is None:
            return
        position, camera = T[:3, 3], self._client.camera
        if self._last is None:
            self._look(position + np.array([-1.5, -2.0, 1.8]), position)
        elif np.linalg.norm(position - self._last) > 1e-3:
            step = position - self._last
            self._move(camera.position + step, camera.look_at + step)
        self._last = position

    def _look(self, position: F64, at: F64) -> None:
        """Look from a place at another, which a narrow window shows above the panel."""
        camera = self._client.camera
        if camera.image_height > _PORTRAIT * camera.image_width:
            at = at - _rise(at - position, _ABOVE_PANEL * np.tan(camera.fov / 2))
        self._move(position, at)

    def _move(self, position: F64, look_at: F64) -> None:
        self._set_position = np.asarray(position)
        with self._client.atomic():
            self._client.camera.position, self._client.camera.look_at = position, look_at


def _rise(view: F64, slope: float) -> F64:
    """Return the step upwards, across a view that is not vertical, of `slope` times its length."""
    up = np.cross(np.cross(view, [0.0, 0.0, 1.0]), view)
    return np.asarray(up / np.linalg.norm(up) * np.linalg.norm(view) * slope)


def _choices(agents: Sequence[str]) -> tuple[str, ...]:
    return (_ORBIT, _ABOVE, *(f"{_FOLLOW}{name}" for name in agents))


def _extent(floor: dr.FloorGrid) -> tuple[F64, float]:
    """Return the centre (3,) and the diagonal of a room."""
    low, high = np.array([*floor.low, floor.z]), np.array([*floor.high, floor.z])
    return (low + high) / 2 + (0.0, 0.0, 0.8), float(np.linalg.norm(high - low))


def _wxyz(R: F64) -> F64:
    return np.asarray(np.roll(quat_from_matrix(R), 1))


def _upright(T_room_body: F64, T_body_cam0: F64) -> F64:
    """Return the rotation (3, 3) about the vertical by which x points where the camera looks."""
    forward = (T_room_body @ T_body_cam0)[:2, 2]
    length = float(np.hypot(*forward))
    c, s = forward / length if length > 1e-6 else (1.0, 0.0)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _small_picture(jpeg: bytes) -> Any:
    """Return a JPEG as a small image (h, w, 3) uint8; None if it cannot be decoded."""
    small = shrunk(jpeg, _PICTURE_PX)
    return None if small is None else np.repeat(small[:, :, None], 3, axis=2)
