"""The sequencer makes complete frames in order, whatever the order of arrival, within bounded memory."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from share.config import SequencerConfig
from share.runtime.source import open_source
from share.sensors.measurement import Measurement
from share.sensors.sequencer import FrameMerger, SequencerCounters, rig_streams, sequence_frames
from share.sensors.stamps import MAX_JUMP_S, WRAP_NS

MS = 1_000_000
RATE = 20.0
STEP = 50 * MS
CONFIG = SequencerConfig()
STEREO_IMU = ("cam0", "cam1", "imu")


def images(stream: str, stamps) -> list[Measurement]:
    return [Measurement(stream, int(s), f"{stream}@{s}") for s in stamps]


def imu(stamps) -> list[Measurement]:
    """Of a living IMU: no two samples are equal."""
    noise = [int(s) // 1000 * 7919 % 10007 * 1e-6 for s in stamps]
    return [
        Measurement("imu", int(s), (float(s % 1000), 0.0, 0.0, n, 0.0, 9.81))
        for s, n in zip(stamps, noise, strict=True)
    ]


def recording(frames: int, start: int = 0, skew: int = 0, before: int = 0) -> list[Measurement]:
    """Stereo at 20 Hz, cam1 later by `skew`, IMU at 200 Hz; in order of time. The images are `before` earlier
    than a sample."""
    times = start + STEP * np.arange(frames) - before
    samples = start + 5 * MS * np.arange(-10, 10 * frames - 9)
    return in_order(imu(samples) + images("cam0", times) + images("cam1", times + skew))


def in_order(measurements: list[Measurement]) -> list[Measurement]:
    return sorted(measurements, key=lambda m: m.stamp_ns)


def run(measurements, streams=STEREO_IMU, config=CONFIG, rate=RATE):
    counters = SequencerCounters()
    return list(sequence_frames(measurements, FrameMerger(streams, rate, config, counters))), counters


def plain(bundles) -> list[tuple]:
    return [
        (b.stamp_ns, b.index, b.image0, b.image1, b.depth, b.gap_ns, b.imu.stamps_ns.tolist())
        for b in bundles
    ]


@pytest.mark.parametrize("before", [0, 1, 1000, MS, 5 * MS - 1])
def test_frames_are_complete_and_the_imu_reaches_them(before):
    """Without a sample at the stamp of the image, the first one after it is the last."""
    bundles, counters = run(recording(10, skew=2 * MS, before=before))
    assert [b.stamp_ns for b in bundles] == [STEP * i - before for i in range(10)]
    assert [b.index for b in bundles] == list(range(10))
    for k, b in enumerate(bundles[1:], 1):
        assert b.image0 == f"cam0@{b.stamp_ns}"
        assert b.image1 == f"cam1@{b.stamp_ns + 2 * MS}"
        assert b.imu.stamps_ns.tolist() == list(range(STEP * (k - 1) + 5 * MS, STEP * k + 1, 5 * MS))
        assert b.imu.gyro[:, 0].tolist() == (b.imu.stamps_ns % 1000).tolist()
    assert counters == SequencerCounters(frames=10, imu_samples=10 + 1 + 9 * 10)


def test_frames_may_be_closer_together_than_imu_samples():
    """The second of two frames between the same two samples has none; no sample is lost."""
    times = 2 * MS * np.arange(1, 51)
    both = in_order(images("cam0", times) + images("cam1", times) + imu(5 * MS * np.arange(21)))
    bundles, counters = run(both, rate=500.0)
    given = -1
    for b in bundles:
        first = -(-b.stamp_ns // (5 * MS)) * 5 * MS
        assert b.imu.stamps_ns.tolist() == [s for s in range(0, first + 1, 5 * MS) if s > given]
        given = max(given, first)
    assert counters == SequencerCounters(frames=50, imu_samples=21)


delays = st.lists(st.integers(0, 95 * MS), min_size=400, max_size=400)


@pytest.mark.long
@settings(max_examples=60, deadline=None)
@given(delays, st.integers(2, 12), st.integers(-4 * MS, 4 * MS), st.integers(0, 5 * MS - 1))
def test_any_bounded_shuffle_gives_the_same_frames(delay, frames, skew, before):
    """Within a stream and between streams: no sample is lost, repeated, or in another frame."""
    config = replace(CONFIG, reorder_ms=100.0)
    ordered = recording(frames, 10**12, skew, before)
    shuffled = [m for _, m in sorted(zip(delay, ordered, strict=False), key=lambda p: p[1].stamp_ns + p[0])]
    assert len(shuffled) == len(ordered)
    expected, counted = run(ordered)
    bundles, counters = run(shuffled, config=config)
    assert plain(bundles) == plain(expected)
    assert counters == counted
    assert counters.frames == frames


@settings(max_examples=60, deadline=None)
@given(
    st.fixed_dictionaries({s: st.integers(0, 95 * MS) for s in STEREO_IMU}),
    st.integers(2, 12),
    st.integers(0, 5 * MS - 1),
)
@example({"cam0": 0, "cam1": 0, "imu": 95 * MS}, 5, 0)
@example({"cam0": 95 * MS, "cam1": 0, "imu": 0}, 5, 1)
def test_streams_out_of_step_give_the_same_frames_without_reordering(lag, frames, before):
    """The default serves a live camera: each stream in order, but not in step with the others."""
    ordered = recording(frames, 10**12, before=before)
    lagged = sorted(ordered, key=lambda m: m.stamp_ns + lag[m.stream])
    assert plain(run(lagged)[0]) == plain(run(ordered)[0])


@settings(max_examples=40, deadline=None)
@given(st.data())
def test_every_measurement_is_used_or_counted(data):
    """Gaps, repeats and steps back anywhere: frames plus counters account for all measurements."""
    ordered = recording(8, 10**12)
    picks = data.draw(st.lists(st.sampled_from(ordered), max_size=150))
    bundles, c = run(picks)
    used = 2 * len(bundles) + c.imu_samples
    assert used + c.duplicates + c.backward + c.unpaired + c.imu_dropped == len(picks)
    assert [b.stamp_ns for b in bundles] == sorted({b.stamp_ns for b in bundles})
    stamps = [s for b in bundles for s in b.imu.stamps_ns.tolist()]
    assert stamps == sorted(set(stamps))
    for before, b in itertools.pairwise(bundles):
        assert (b.imu.stamps_ns > before.stamp_ns).all()
        assert (b.imu.stamps_ns[:-1] < b.stamp_ns).all()


@pytest.mark.parametrize("before", [0, 1, 4 * MS])
def test_a_frame_is_yielded_as_soon_as_it_is_complete(before):
    """No frame waits for the next one."""
    counters, fed, out = SequencerCounters(), [], []

    def feed():
        for m in recording(5, before=before):
            fed.append(m.stamp_ns)
            yield m

    out = [
        (b.stamp_ns, fed[-1])
        for b in sequence_frames(feed(), FrameMerger(STEREO_IMU, RATE, CONFIG, counters))
    ]
    assert all(now == stamp + before for stamp, now in out[:-1])


@pytest.mark.parametrize("shift", [20 * MS, -20 * MS, 300 * MS])
def test_an_imu_with_a_shifted_clock_gives_the_same_samples(shift):
    """A frame waits until the IMU has reached the time when its image was taken, and no longer."""
    expected, _ = run(recording(12))
    late = [replace(m, stamp_ns=m.stamp_ns + shift) if m.stream == "imu" else m for m in recording(12)]
    counters, newest = SequencerCounters(), [0]

    def feed():
        for m in in_order(late):
            newest.append(m.stamp_ns)
            yield m

    for b, e in zip(
        sequence_frames(feed(), FrameMerger(STEREO_IMU, RATE, CONFIG, counters, imu_shift_ns=shift)),
        expected,
        strict=True,
    ):
        assert (b.stamp_ns, b.image0, b.image1) == (e.stamp_ns, e.image0, e.image1)
        assert (b.imu.stamps_ns - shift).tolist() == e.imu.stamps_ns.tolist()
        assert newest[-1] == b.stamp_ns + max(shift, 0)
    assert counters == SequencerCounters(frames=12, imu_samples=12 * 10 + 1)


def test_duplicates_and_steps_back_are_dropped_and_counted():
    ordered = recording(6)
    again = [m for m in ordered for _ in range(2)]
    bundles, counters = run(again)
    assert plain(bundles) == plain(run(ordered)[0])
    assert counters.duplicates == len(ordered)
    late = [*ordered[:60], *ordered[5:8], *ordered[60:]]
    bundles, counters = run(late)
    assert plain(bundles) == plain(run(ordered)[0])
    assert counters.backward == 3
    swapped = [*ordered[:64], ordered[65], ordered[64], *ordered[66:]]  # two IMU samples of one frame
    assert [m.stream for m in swapped[64:66]] == ["imu", "imu"]
    assert run(swapped)[1].backward == 1
    bundles, counters = run(swapped, config=replace(CONFIG, reorder_ms=10.0))
    assert plain(bundles) == plain(run(ordered)[0])
    assert counters.backward == 0


def test_a_missing_partner_drops_the_frame():
    ordered = [m for m in recording(6) if not (m.stream == "cam1" and m.stamp_ns == 2 * STEP)]
    bundles, counters = run(ordered)
    assert [b.stamp_ns // STEP for b in bundles] == [0, 1, 3, 4, 5]
    assert counters.unpaired == 1
    assert len(bundles[2].imu) == 20  # nothing of the IMU is lost with the frame
    bundles, counters = run(recording(6, skew=6 * MS))
    assert bundles == []
    assert counters.unpaired == 12


def test_a_dead_cam1_or_cam0_blocks_nothing():
    blind = [m for m in recording(200) if m.stream == "cam0"]
    assert run(blind)[1].unpaired == 200
    assert run([m for m in recording(200) if m.stream != "cam0"])[1].unpaired == 200


def test_frames_go_on_without_a_dead_cam1_if_the_imu_is_alive():
    died = [m for m in recording(200) if m.stream != "cam1" or not 50 * STEP < m.stamp_ns < 150 * STEP]
    bundles, counters = run(died)
    alone = [b.stamp_ns // STEP for b in bundles if b.image1 is None]
    assert alone == list(range(151 - len(alone), 151))  # once that is certain, until it is back
    assert 70 < len(alone) <= 85
    assert [b.stamp_ns // STEP for b in bundles if b.image1] == [*range(51), *range(151, 200)]
    assert counters.unpaired == 101 - len(alone)
    assert run([m for m in died if m.stamp_ns < 140 * STEP])[0][-1].stamp_ns == 139 * STEP
    assert run([m for m in died if m.stream != "imu"])[1].frames == 100  # none without its partner


@pytest.mark.parametrize("pause", [21, 100])
def test_no_stream_is_dead_after_a_pause_of_all_cameras(pause):
    """The first image after it waits for its partner, though the IMU goes on meanwhile."""
    paused = range(10 * STEP, (9 + pause) * STEP)
    ordered = [m for m in recording(pause + 20) if m.stream == "imu" or m.stamp_ns not in paused]
    bundles, counters = run(ordered)
    assert [b.stamp_ns // STEP for b in bundles] == [*range(10), *range(pause + 9, pause + 20)]
    assert all(b.image1 == b.image0.replace("cam0", "cam1") for b in bundles)
    assert counters.unpaired == counters.imu_silent == counters.imu_dropped == 0


def test_real_images_seconds_apart_are_paired(shared_data):
    source, counters = open_source(str(shared_data / "real" / "euroc_v1_01_keyframes")), SequencerCounters()
    streams = rig_streams(source.rig)
    merger = FrameMerger(streams, source.rate_hz, CONFIG, counters)
    bundles = list(sequence_frames(source.measurements(), merger))
    assert len(bundles) == 50
    assert np.diff([b.stamp_ns for b in bundles]).max() > 7e9
    assert all(b.image1 is not None for b in bundles)
    assert counters.unpaired == 0


def test_depth_beside_stereo_may_be_missing():
    times = STEP * np.arange(200)
    kept = times[(times != 5 * STEP) & (times < 100 * STEP)]
    ordered, fed, late = in_order(recording(200) + images("depth", kept)), [], []

    def feed():
        for m in ordered:
            fed.append(m.stamp_ns)
            yield m

    streams = ("cam0", "cam1", "depth", "imu")
    out = []
    for b in sequence_frames(feed(), FrameMerger(streams, RATE, CONFIG, SequencerCounters())):
        out.append(b)
        late.append(fed[-1] - b.stamp_ns)
    assert [b.stamp_ns for b in out] == times.tolist()
    assert [b.stamp_ns for b in out if b.depth is not None] == kept.tolist()
    assert all(b.image1 is not None and b.gap_ns == 0 for b in out)
    assert max(late[:5]) == 0
    assert max(late[130:-1]) == 0  # a dead stream is not waited for


def test_a_silent_imu_does_not_end_the_run():
    """Silent from 1 s to 3 s: frames go on, first 100 ms late, then at once; then it is back."""
    ordered = [m for m in recording(80) if m.stream != "imu" or not 10**9 < m.stamp_ns <= 3 * 10**9]
    newest, lateness = 0, {}

    def feed():
        nonlocal newest
        for m in ordered:
            newest = m.stamp_ns
            yield m

    counters = SequencerCounters()
    for b in sequence_frames(feed(), FrameMerger(STEREO_IMU, RATE, CONFIG, counters)):
        lateness[b.stamp_ns // STEP] = newest - b.stamp_ns
    assert sorted(lateness) == list(range(80))
    assert counters.imu_silent == 40
    assert 100 * MS <= lateness[25] <= 160 * MS
    assert lateness[50] == 0
    assert lateness[70] == 0


def test_frames_go_on_without_any_imu_sample():
    bundles, counters = run([m for m in recording(30) if m.stream != "imu"])
    assert len(bundles) == counters.imu_silent == 30


def test_gaps_are_marked():
    ordered = [m for m in recording(20) if m.stream == "imu" or not 5 * STEP < m.stamp_ns < 9 * STEP]
    bundles, counters = run(ordered)
    assert [(b.stamp_ns // STEP, b.gap_ns // STEP) for b in bundles if b.gap_ns] == [(9, 4)]
    assert counters.gaps == 1
    assert run(ordered, rate=0.0)[1].gaps == 0  # without a rate there is no gap


@pytest.mark.parametrize("lag", [0, 40 * MS, 80 * MS])
def test_the_wrap_of_the_d4xx_clock_is_unwrapped(lag):
    """Also with the IMU ahead of the cameras by `lag`."""
    ordered = recording(40, WRAP_NS - 10 * STEP)
    ordered.sort(key=lambda m: m.stamp_ns + (lag if m.stream != "imu" else 0))
    bundles, counters = run([replace(m, stamp_ns=m.stamp_ns % WRAP_NS) for m in ordered])
    assert plain(bundles) == plain(run(ordered)[0])
    assert len(bundles) == 40
    assert (counters.wraps, counters.backward, counters.gaps, counters.jumps) == (1, 0, 0, 0)


@pytest.mark.long
def test_the_clock_wraps_more_than_once():
    stamps = np.arange(0, 3 * WRAP_NS, 10**9)
    bundles, counters = run(images("cam0", stamps % WRAP_NS), ("cam0",), rate=1.0)
    assert [b.stamp_ns for b in bundles] == stamps.tolist()
    assert (counters.wraps, counters.gaps) == (2, 0)


def test_a_jump_is_accepted_after_three_consistent_samples_and_marks_a_gap():
    ordered = recording(10) + recording(10, 3600 * 10**9)
    bundles, counters = run(ordered)
    assert len(bundles) == 20
    assert (counters.jumps, counters.gaps, counters.strays) == (1, 1, 0)
    assert bundles[10].gap_ns == 3600 * 10**9 - 9 * STEP
    assert len(bundles[10].imu) == 11  # only those near it


def test_a_stray_stamp_is_dropped():
    ordered = recording(20)
    stray = replace(ordered[50], stamp_ns=10**18)
    bundles, counters = run([*ordered[:60], stray, *ordered[60:]])
    assert plain(bundles) == plain(run(ordered)[0])
    assert (counters.strays, counters.jumps) == (1, 0)


def test_the_distant_past_is_dropped_and_counted():
    ordered = recording(10, 10**15)
    bundles, counters = run(ordered + recording(10))
    assert len(bundles) == 10
    assert counters.backward == len(recording(10))


def test_rgbd_frames_ignore_other_streams():
    times = STEP * np.arange(5)
    ordered = in_order(images("cam0", times) + images("depth", times) + images("cam1", times) + imu(times))
    bundles, counters = run(ordered, ("cam0", "depth"))
    assert [b.depth for b in bundles] == [f"depth@{t}" for t in times]
    assert all(b.image1 is None and len(b.imu) == 0 for b in bundles)
    assert counters == SequencerCounters(frames=5)


@pytest.mark.long
@pytest.mark.parametrize("without", ["cam0", "cam1", "imu"])
def test_memory_is_bounded_if_a_stream_dies(without):
    """Ten minutes of two streams without the third: few samples wait."""
    counters = SequencerCounters()
    merger = FrameMerger(STEREO_IMU, RATE, CONFIG, counters)
    most = 0
    for second in range(0, 600, 40):
        for m in recording(20 * 40, second * 10**9 + 10**12):
            if m.stream != without:
                merger.add(m.stream, m.stamp_ns, m.payload)
                for _ in merger.ready_frames():
                    pass
                most = max(most, sum(len(b.items) for b in merger.buffers.values()))
    assert most < 200 * MAX_JUMP_S + 200
