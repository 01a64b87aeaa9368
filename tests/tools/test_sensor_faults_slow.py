"""How the inertial tracker copes with each fault on its own, on 20 s of a walk. See measure_faults.py.

What is not good enough yet is in `FAR` and `WRONG`, with the figure: once it is, it fails here
until it is taken out.
"""

from functools import cache

import pytest
from helpers.experiments import experiment

from share.lab.emulate.recipe import SessionRecipe
from share.lab.emulate.render.context import missing_reason
from share.lab.emulate.session import make_cached_session

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(missing_reason() is not None, reason=f"cannot draw: {missing_reason()}"),
]
FAULTS = experiment("sensor_faults").FAULTS
SESSIONS = {
    "warehouse": SessionRecipe("warehouse", ("a=walk:",), 20.0, seed=7, profiles={"": "d435i:640x480@30"}),
    "firestation": SessionRecipe("firestation", ("a=walk:",), 20.0, seed=3),
    "firestation 11": SessionRecipe("firestation", ("a=walk:",), 20.0, seed=11),
}
BORNE = [(session, fault) for session in ("warehouse", "firestation") for fault in FAULTS]
# What goes along with a wearer does harm in one walk of three: 1.0, 5.5, 0.6 cm by seeds 3, 11, 12.
BORNE[BORNE.index(("firestation", "mover_along"))] = ("firestation 11", "mover_along")
TIMES, LEAST_CM = 2.0, 0.5  # as far off as without the fault; below LEAST_CM chance decides
FAR = {
    ("firestation", "imu_silent_1s"): "1.4 cm: 15 to 23 features in a turn",
    ("firestation 11", "mover_along"): "5.5 cm: half of the view goes along, before bare walls",
}
WRONG = {
    ("firestation", "imu_silent_1s"): "0.5 % of the frames",
    ("firestation 11", "mover_along"): "40 % of the frames",
}


@pytest.fixture(scope="module")
def row_of():
    """The figures of a fault in a session; each is tracked once."""
    tool = experiment("measure_faults")

    @cache
    def case(session):
        return tool.case(f"{make_cached_session(SESSIONS[session])}/a", SESSIONS[session].seconds)

    @cache
    def row(session, fault):
        return tool.measured(case(session), FAULTS[fault])

    return row


def each(not_yet):
    """All faults of all sessions, those of `not_yet` expected to fail."""

    def marks(key):
        return (
            pytest.mark.xfail(strict=True, raises=AssertionError, reason=not_yet[key])
            if key in not_yet
            else ()
        )

    return pytest.mark.parametrize(
        ("session", "fault"), [pytest.param(*key, marks=marks(key)) for key in BORNE]
    )


@pytest.mark.parametrize("session", SESSIONS)
def test_a_clean_recording_is_tracked_accurately(row_of, session):
    clean = row_of(session, "clean")
    assert clean["ate_cm"] < 0.8
    assert clean["states"]["OK"] > 88  # a firestation has bare walls


@each(FAR)
def test_the_error_is_at_most_doubled(row_of, session, fault):
    clean = max(row_of(session, "clean")["ate_cm"], LEAST_CM)
    assert row_of(session, fault)["ate_cm"] <= TIMES * clean


@each({})
def test_tracking_is_never_lost(row_of, session, fault):
    row = row_of(session, fault)
    assert row["lost_s"] == 0
    assert row["stretches"] == 1


@each(WRONG)
def test_frames_reported_ok_have_small_errors(row_of, session, fault):
    """Not off by more than 5 cm and more than three sigmas."""
    assert row_of(session, fault)["wrong_ok"] == 0
