"""The headset page's modules that compute, against their references in Python."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from helpers import emulated_wearer as worn
from helpers.browser import BrowserPage
from helpers.headset_reference import PosePair, SpaceAlignment, pose_cov, predict_pose
from helpers.headset_wearer import T_body_viewer, wearer

from share.geometry import se3
from share.types import F64

pytestmark = pytest.mark.long


def columns(T: F64) -> list[float]:
    """A transform as the page has it."""
    return [float(value) for value in T.ravel(order="F")]


def run(page: BrowserPage, module: str, expression: str, **data: Any) -> Any:
    """Return an expression of a module's names `m` and of data."""
    names = ", ".join(data)
    script = f'import("/{module}.js").then((m) => (({{{names}}}) => ({expression}))({json.dumps(data)}))'
    return page.evaluate(script)


@pytest.mark.parametrize("size", [0.0, 1e-7, 1e-4, 0.3, 2.0, np.pi - 1e-6])
def test_transforms_are_those_of_se3(modules: BrowserPage, rng: np.random.Generator, size: float) -> None:
    axis = rng.normal(size=3)
    xi = np.concatenate([axis / np.linalg.norm(axis) * size, rng.normal(size=3)])
    A, B = se3.exp(xi), se3.exp(rng.normal(size=6))
    S = B[:3, :3] @ np.diag([1.0, 2, 3]) @ B[:3, :3].T
    S6 = np.kron(np.eye(2), S) + 0.1
    found = run(
        modules,
        "math",
        """({
            exp: [...m.exp(new Float64Array(16), xi)],
            log: m.log(A),
            product: [...m.multiply(new Float64Array(16), A, B)],
            inverse: [...m.inverse(new Float64Array(16), A)],
            adjoint: [...m.adjoint(A)],
            again: [...m.orthonormal(new Float64Array(16), A)],
            rows: m.toRows(m.fromRows(m.toRows(A))),
            solved: [...m.solve6(S6, rhs)],
            slerp: [...m.slerp(new Float64Array(4), qa, qb, 0.3)],
        })""",
        xi=xi.tolist(),
        A=columns(A),
        B=columns(B),
        S6=S6.ravel().tolist(),
        rhs=xi.tolist(),
        qa=se3.quat_from_matrix(A[:3, :3]).tolist(),
        qb=se3.quat_from_matrix(B[:3, :3]).tolist(),
    )
    between = A[:3, :3] @ se3.so3_exp(0.3 * se3.so3_log(A[:3, :3].T @ B[:3, :3]))
    expected = {
        "exp": columns(A),
        "product": columns(A @ B),
        "inverse": columns(se3.inverse(A)),
        "adjoint": se3.adjoint(A).ravel(),
        "again": columns(A),
        "rows": A.ravel(),
        "solved": np.linalg.solve(S6, xi),
    }
    for name, values in expected.items():
        assert np.allclose(found[name], values, atol=1e-9), name
    assert np.allclose(se3.exp(np.array(found["log"])), A, atol=1e-9)
    assert np.allclose(se3.matrix_from_quat(np.array(found["slerp"])), between, atol=1e-9)


@pytest.mark.parametrize("ahead_s", [-0.01, 0.0, 0.02, 0.1, 0.5])
def test_prediction_is_the_reference(modules: BrowserPage, rng: np.random.Generator, ahead_s: float) -> None:
    T, velocity, turning = se3.exp(rng.normal(size=6)), rng.normal(size=3), 2 * rng.normal(size=3)
    given = {"T": columns(T), "v": velocity.tolist(), "w": turning.tolist(), "ahead": ahead_s}
    found = run(modules, "prediction", "[...m.predictPose(new Float64Array(16), T, v, w, ahead)]", **given)
    assert np.allclose(found, columns(predict_pose(T, velocity, turning, ahead_s)), atol=1e-12)


def alignment_vectors(seed: int) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Return pairs of a wearer, with all that can happen to them, and what becomes of each by the
    reference."""
    pairs, _ = wearer(seed)
    moved = se3.exp(np.array([0, 0.5, 0, 0.3, -0.2, 0]))  # recentred unnoticed
    jump = se3.exp(np.array([0, 0, 0, 0.3, 0, 0]))
    alignment, given, expected = SpaceAlignment(T_body_viewer), [], []
    for k, one in enumerate(pairs[:200]):
        local = moved @ one.T_local_viewer if k >= 120 else one.T_local_viewer
        body = one.T_map_body @ jump if k in (40, 41, 90) else one.T_map_body
        pair = PosePair(one.time_s, "other" if k >= 170 else "map", body, one.cov, local)
        alignment, outcome = alignment.after(pair)
        given.append(
            {
                "timeS": pair.time_s,
                "mapId": pair.map_id,
                "T_map_body": columns(body),
                "cov": pair.cov.ravel().tolist(),
                "T_local_viewer": columns(local),
            }
        )
        assert alignment.T_map_local is not None and alignment.cov is not None
        expected.append(
            {
                "outcome": str(outcome.value),
                "T": columns(alignment.T_map_local),
                "cov": alignment.cov.ravel().tolist(),
                "at": alignment.cov_at(local).ravel().tolist(),
            }
        )
    assert {one["outcome"] for one in expected} == {"started", "used", "refused", "restarted"}
    return given, expected


@pytest.mark.parametrize("seed", [3, 4])
def test_alignment_is_the_reference(modules: BrowserPage, seed: int) -> None:
    given, expected = alignment_vectors(seed)
    found = run(
        modules,
        "alignment",
        """(() => {
            let alignment = new m.SpaceAlignment(Float64Array.from(mount)), outcome;
            return pairs.map((pair) => {
                const [T_map_body, cov] = [pair.T_map_body, pair.cov].map((one) => Float64Array.from(one));
                const T_local_viewer = Float64Array.from(pair.T_local_viewer);
                [alignment, outcome] = alignment.after({ ...pair, T_map_body, cov, T_local_viewer });
                const at = [...alignment.covAt(T_local_viewer)];
                return { outcome, T: [...alignment.T_map_local], cov: [...alignment.cov], at };
            });
        })()""",
        mount=columns(T_body_viewer),
        pairs=given,
    )
    assert [one["outcome"] for one in found] == [one["outcome"] for one in expected]
    for name, scale in (("T", 1.0), ("cov", 1e-4), ("at", 1e-4)):
        values, wanted = (np.array([row[name] for row in rows]) for rows in (found, expected))
        assert np.abs(values - wanted).max() < 1e-8 * scale, name


@pytest.mark.parametrize("sigmas", [(None, None), (0.03, None), (None, 0.01), (0.0, 0.0), (2.5, 0.7)])
def test_how_certain_a_pose_is(modules: BrowserPage, sigmas: tuple[float | None, float | None]) -> None:
    found = run(modules, "alignment", "[...m.poseCov(...sigmas)]", sigmas=sigmas)
    assert np.allclose(found, pose_cov(*sigmas).ravel(), atol=1e-15)


def test_history_interpolates(modules: BrowserPage, rng: np.random.Generator) -> None:
    T = se3.exp(np.cumsum(rng.normal(size=(300, 6)) * 0.05, axis=0))  # more than are kept
    times = 1000 + 11.0 * np.arange(300)
    times[290:] += 500  # a gap
    asked = [1000 + 11 * 200 + 3.3, times[295] + 1.0, times[289] + 100, times[299] + 1, times[5]]
    found = run(
        modules,
        "viewer-history",
        """(() => {
            const history = new m.ViewerHistory();
            poses.forEach((T, k) => history.add(times[k], Float64Array.from(T)));
            return asked.map((time) => { const T = history.at(time); return T && [...T]; });
        })()""",
        poses=[columns(one) for one in T],
        times=times.tolist(),
        asked=asked,
    )
    for k, share, pose in ((200, 0.3, found[0]), (295, 1 / 11, found[1])):
        R = T[k, :3, :3] @ se3.so3_exp(share * se3.so3_log(T[k, :3, :3].T @ T[k + 1, :3, :3]))
        t = T[k, :3, 3] + share * (T[k + 1, :3, 3] - T[k, :3, 3])
        assert np.allclose(pose, columns(se3.from_rt(R, t)), atol=1e-9)
    assert found[2:] == [None, None, None]


@pytest.mark.parametrize(
    ("gap_ms", "after_ms", "is_known"),
    [(100, 50, True), (120, 60, False), (250, 10, True), (250, 240, True), (250, 20, False), (310, 1, False)],
)
def test_between_distant_poses_only_what_is_near_one_is_known(
    modules: BrowserPage, gap_ms: float, after_ms: float, is_known: bool
) -> None:
    script = """(() => {
        const history = new m.ViewerHistory();
        [1000, 1000 + gap].forEach((time) => history.add(time, Float64Array.from(pose)));
        return history.at(1000 + after) !== null;
    })()"""
    pose = columns(np.eye(4))
    assert run(modules, "viewer-history", script, gap=gap_ms, after=after_ms, pose=pose) == is_known


def test_of_clock_samples_the_least_round_trip_counts(modules: BrowserPage) -> None:
    found = run(
        modules,
        "clock",
        """(() => {
            const clock = new m.ServerClock();
            const before = clock.toPage(0);
            clock.add(100, 5150, 140);
            clock.add(200, 5202, 204);  // 4 ms there and back: 5000 ahead
            clock.add(300, 5390, 400);
            return [before, clock.toPage(6000), clock.roundTripMs];
        })()""",
    )
    assert found == [None, 1000, 4]


def test_a_clock_is_kept_until_a_sample_contradicts_it(modules: BrowserPage) -> None:
    """After a reconnection to an edge that is busy answers take long, and say little."""
    found = run(
        modules,
        "clock",
        """(() => {
            const clock = new m.ServerClock(), said = [];
            const add = (...sample) => {
                clock.add(...sample);
                said.push([clock.toPage(6000), clock.sigmaMs]);
            };
            add(200, 5202, 204);  // 5000 ahead
            add(900, 6300, 1300);  // within its bounds: 200 more or less
            add(2000, 9000, 2012);  // 6994 ahead: the server's machine has started anew
            add(3000, 9998, 3004);
            return said;
        })()""",
    )
    sigmas_ms = [2 / np.sqrt(3), 2 / np.sqrt(3), 6 / np.sqrt(3), 2 / np.sqrt(3)]
    assert np.allclose(found, np.transpose([[1000, 1000, -994, -996], sigmas_ms]))


def test_how_fast_a_viewer_moves_and_turns(modules: BrowserPage) -> None:
    T = [columns(se3.exp(np.array([0.0, 0.02, 0, 0, 0, 0.01]) * k)) for k in range(3)]
    script = """(() => {
        const history = new m.ViewerHistory();
        poses.forEach((T, k) => history.add(1000 + 20 * k, Float64Array.from(T)));
        return [1005, 1040, 999, 1041].map((time) => Object.values(history.speedsAt(time)));
    })()"""
    found = run(modules, "viewer-history", script, poses=T)
    assert np.allclose(found, [[1.0, 0.5], [1.0, 0.5], [0, 0], [0, 0]], atol=1e-4)


def test_poses_whose_time_is_hardly_known_move_no_alignment_of_one_who_turns(modules: BrowserPage) -> None:
    """Their times are 150 ms wrong for 3 s: the space was aligned anew, and again once they were right."""
    found = run(
        modules,
        "placement",
        """(() => {
            const told = [], placement = new m.Placement((text) => told.push(text));
            placement.setMount(Float64Array.from(mount), 0);
            const cov = Float64Array.from({ length: 36 }, (_, k) => (k % 7 === 0 ? 1e-5 : 0));
            const x = [];
            viewers.forEach((T, k) => {
                const isWrong = k >= 200 && k < 400;
                const [timeMs, timeSigmaMs] = isWrong ? [15 * k - 165, sigmaMs] : [15 * k - 15, 1];
                if (k > 20 && k % 3 === 0) {
                    const [T_map_body, at] = [Float64Array.from(bodies[k - 1]), timeMs];
                    placement.addPose({ timeMs: at, timeSigmaMs, mapId: "a", T_map_body, cov });
                }
                placement.update(15 * k, Float64Array.from(T));
                if (k > 30) x.push([...placement.T_map_local].slice(12, 15));
            });
            return [told.filter((text) => text.includes("anew")).length, x];
        })()""",
        mount=columns(worn.T_body_viewer),
        **turning(),
        sigmaMs=150.0,
    )
    anew, places = found
    assert anew <= 1  # the first
    assert np.linalg.norm(np.array(places) - places[0], axis=1).max() < 0.1


def turning() -> dict[str, list[list[float]]]:
    """Who looks about at up to 1.3 rad/s and walks: viewers in the headset's space, bodies in the map."""
    viewers = [
        se3.from_rt(se3.so3_exp(np.array([0, 0.8 * np.sin(0.024 * k), 0])), np.array([0.005 * k, 1.6, 0]))
        for k in range(600)
    ]
    bodies = [T @ se3.inverse(worn.T_body_viewer) for T in viewers]
    return {"viewers": list(map(columns, viewers)), "bodies": list(map(columns, bodies))}


def test_percentiles(modules: BrowserPage) -> None:
    values = [float(k) for k in range(1, 101)]
    script = (
        "(() => { const l = new m.Latency(); v.forEach((x) => l.add(x)); return [l.take(), l.take()]; })()"
    )
    summary = {"frames": 100, "over_20ms": 80, "p50_ms": 50, "p95_ms": 95, "p99_ms": 99}
    assert run(modules, "latency", script, v=values) == [summary, None]


def test_a_jump_eases_at_the_wearer_and_is_said(modules: BrowserPage) -> None:
    """Maps are joined, and the first pair in the new one contradicts by 20 cm what was drawn."""
    T_new_old = se3.exp(np.array([0, 0, 0.4, 3.0, -2, 0.1]))
    error = se3.from_rt(np.eye(3), np.array([0.2, 0.0, 0]))
    found = run(
        modules,
        "placement",
        """(() => {
            const told = [], placement = new m.Placement((text) => told.push(text));
            placement.setMount(Float64Array.from(mount), 0);
            const cov = Float64Array.from({ length: 36 }, (_, k) => (k % 7 === 0 ? 1e-6 : 0));
            const pose = (timeMs, mapId, T) =>
                placement.addPose({ timeMs, mapId, T_map_body: Float64Array.from(T), cov });
            const V = Float64Array.from(viewer), x = [];
            const frame = (timeMs) => {
                placement.update(timeMs, V);
                x.push([timeMs, placement.mapId, [...placement.T_map_local]]);
            };
            frame(0); pose(5, "a", body); frame(11);
            placement.joined("a", "b", Float64Array.from(join)); frame(22);
            for (let k = 3; k < 200; k++) { pose(11 * k - 5, "b", wrong); frame(11 * k); }
            return [told, x];
        })()""",
        mount=columns(worn.T_body_viewer),
        viewer=columns(worn.viewer_pose(0, False)),
        body=columns(np.eye(4)),
        join=columns(T_new_old),
        wrong=columns(error @ T_new_old),
    )
    told, frames = found
    V = worn.viewer_pose(0, False)
    drawn = np.array([(np.reshape(T, (4, 4), order="F") @ V)[:3, 3] for _, _, T in frames])
    assert frames[0][1] is None and [one[1] for one in frames[1:3]] == ["a", "b"]
    start = (se3.from_rt(np.eye(3), np.zeros(3)) @ worn.T_body_viewer)[:3, 3]
    before, after = ((T @ np.append(start, 1))[:3] for T in (T_new_old, error @ T_new_old))
    assert np.allclose(drawn[2], before, atol=1e-6)  # the join alone moves nothing
    steps = np.linalg.norm(np.diff(drawn[2:], axis=0), axis=1)
    assert np.allclose(drawn[-1], after, atol=1e-3) and steps.max() < 0.2 * 1.6 * 11 / 500
    assert any("20.0 cm" in text and "0.5 s" in text for text in told)


def test_what_is_followed_does_not_flap_where_poses_are_as_old_as_they_may_be(modules: BrowserPage) -> None:
    """Frames at 72 Hz for 20 s, poses at 30 Hz that arrive late; follow is wanted after 1 s."""
    stamps = np.arange(600) * 100 / 3
    inside = (stamps > 5000) & (stamps < 6500)
    found = run(
        modules,
        "placement",
        """lates.map((late) => {
            const placement = new m.Placement(), words = new Set();
            placement.setMount(null, 0);
            const T = Float64Array.from({ length: 16 }, (_, k) => (k % 5 === 0 ? 1 : 0));
            const cov = Float64Array.from({ length: 36 }, (_, k) => (k % 7 === 0 ? 1e-6 : 0));
            const poses = stamps.map((timeMs, k) => ({ timeMs, atMs: timeMs + late[k] }));
            let flips = 0, wasHeld = null;
            for (let frame = 0; frame < 72 * 20; frame++) {
                const timeMs = (1000 * frame) / 72;
                if (frame === 72) placement.setMode("follow");
                for (const one of poses.filter(({ atMs }) => atMs <= timeMs)) {
                    placement.addPose({ timeMs: one.timeMs, mapId: "a", T_map_body: T, cov });
                    one.atMs = Infinity;
                }
                placement.update(timeMs, T);
                if (frame < 72) continue;
                if (wasHeld !== null && placement.isHeld !== wasHeld) flips++;
                wasHeld = placement.isHeld;
                if (wasHeld) words.add(placement.whyHeld(timeMs));
            }
            return [flips, wasHeld, [...words].sort()];
        })""",
        stamps=stamps.tolist(),
        lates=[
            late.tolist()
            for late in (
                np.full(600, 50.0),
                970 + 20 * np.sin(stamps),  # as old as they may be, and often older
                np.full(600, 1200.0),
                np.where(inside, 1e9, 50.0),  # none for 1.5 s
                np.maximum(1300 - stamps % 2000, 50),  # a stall of 1.3 s every 2 s
                np.where(stamps > 5000, 1e9, 50.0),
            )
        ],
    )
    was, are = (f"poses {one} over 1 s old" for one in ("were", "are"))
    steady, edgy, old, gap, stalls, ended = found
    assert steady == [0, False, []] and ended == [1, True, ["no new pose"]]
    assert edgy == [1, True, [are, was]] and old == [0, True, ["no new pose", are]]  # until the first
    assert gap == [2, False, ["no new pose", was]]
    assert stalls[:2] == [0, True]
