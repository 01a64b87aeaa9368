"""Quality of experience against the printed formulas, worked out by hand."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from share import config as settings
from share.config import ControlConfig
from share.errors import ConfigError
from share.plain_data import to_mapping
from share.scheduling.qoe import QoeParameters, accuracy, qoe, qoe_factors
from share.types import AgentKind

AR = QoeParameters(AgentKind.AR, beta=0.01, gamma=0.5, theta_ms=20, target=0.9)
ROBOT = QoeParameters(AgentKind.ROBOT, beta=2, gamma=100, theta_ms=25, target=0.9)
delays = st.floats(0, 5000)
errors = st.floats(0, 50)


@pytest.mark.parametrize(
    ("needs", "delay_ms", "error_cm", "expected"),
    [
        (AR, 20, 0.5, 0.6321205588285577),  # 1 - e^-1
        (AR, 120, 0.5, 0.2325441579348192),  # e^-1 (1 - e^-1)
        (AR, 5, 0.25, 0.8646647167633873),  # 1 - e^-2: an advance is no penalty
        (replace(AR, signed=True), 10, 0.25, 0.9556022988530124),  # e^0.1 (1 - e^-2)
        (AR, 20, 0.0, 0.9999546000702375),  # 1 - e^-10: no error below 0.05 cm is believed
        (AR, 20, None, 0.3934693402873666),  # 1 - e^-0.5: as of 1 cm
        (ROBOT, 75, 1.0, 0.6321205588285577),  # 1 - e^-1
        (ROBOT, 25, 2.0, 0.3180923728035784),  # e^-1 (1 - e^-2)
        (ROBOT, 75, 0.5, 0.6321205588285577),
        (replace(ROBOT, signed=True), 75, 0.5, 4.670774270471605),  # e^2 (1 - e^-1) = e^2 - e
        (ROBOT, 25, None, 0.8646647167633873),
    ],
)
def test_printed_formulas(
    needs: QoeParameters, delay_ms: float, error_cm: float | None, expected: float
) -> None:
    assert math.isclose(qoe(delay_ms, error_cm, needs), expected, rel_tol=0, abs_tol=1e-12)


def test_accuracy_is_one_over_the_error_with_a_floor() -> None:
    assert [accuracy(e) for e in (0.0, 0.05, 0.5, 4.0, None)] == [20.0, 20.0, 2.0, 0.25, 1.0]


@given(delays, delays, errors, errors, st.sampled_from(AgentKind), st.booleans())
def test_less_delay_and_less_error_are_never_worse(
    d1: float, d2: float, e1: float, e2: float, kind: AgentKind, signed: bool
) -> None:
    needs = QoeParameters.from_config(ControlConfig(signed_penalty=signed), kind)
    better, worse = qoe(min(d1, d2), min(e1, e2), needs), qoe(max(d1, d2), max(e1, e2), needs)
    assert 0 <= worse <= better < math.inf
    assert signed or better <= 1


def test_extreme_values_give_finite_qoe() -> None:
    needs = replace(ROBOT, beta=1e9, signed=True)
    assert math.isfinite(qoe(0, 0, needs)) and qoe(1e300, 1e300, needs) == 0


def test_default_targets_are_met_at_the_documented_delays_and_errors() -> None:
    ar, robot = (QoeParameters.from_config(ControlConfig(), kind) for kind in (AgentKind.AR, AgentKind.ROBOT))
    assert abs(qoe(20, 1.35, ar) - ar.target) < 0.02
    assert qoe(200, 0.5, robot) < robot.target < qoe(100, 0.5, robot)
    for needs, delay_ms, wrong_cm in ((ar, 200, 30), (robot, 1000, 10)):
        assert (
            qoe(10, 0.1, needs) > 0.98
            and qoe(delay_ms, 0.5, needs) < 0.35
            and qoe(10, wrong_cm, needs) < 0.15
        )


def test_the_table_of_the_documentation_is_correct() -> None:
    text = (Path(__file__).parents[2] / "docs" / "understand" / "scheduling.md").read_text()
    table = text.split("<!-- QoE by default")[1].split("\n\n")[1].splitlines()
    ar, robot = (QoeParameters.from_config(ControlConfig(), kind) for kind in (AgentKind.AR, AgentKind.ROBOT))
    points = [(ar, d) for d in (10, 20, 50, 100, 200)] + [(robot, d) for d in (20, 100, 200, 500, 1000)]
    for row in table[2:]:
        error_cm, *cells = (float(cell) for cell in row.strip("| ").split("|"))
        assert cells == [round(qoe(d, error_cm, needs), 2) for needs, d in points]
    assert len(table) == 8


def test_one_agent_may_have_its_own_parameters() -> None:
    text = "control: {agents: {bob: {form: ar, target: 0.8}, ann: {beta: 0}}}"
    control = settings.load_config(text).control
    bob = QoeParameters.from_config(control, AgentKind.ROBOT, "bob")
    assert bob == replace(QoeParameters.from_config(control, AgentKind.AR), target=0.8)
    assert QoeParameters.from_config(control, AgentKind.AR, "ann").beta == 0
    assert QoeParameters.from_config(control, AgentKind.ROBOT, "carl") == QoeParameters.from_config(
        ControlConfig(), AgentKind.ROBOT
    )
    assert to_mapping(control)["agents"]["bob"]["form"] == "ar"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("agents: {bob: {from: ar}}", "control: agents: bob: unknown key 'from'; did you mean 'form'"),
        ("agents: {bob: {form: car}}", "control: agents: bob: form: 'car' is not known"),
        ("agents: {bob: {theta_ms: 0}}", "control: agents: bob: theta_ms: 0.0 must be positive"),
        ("agents: [bob]", "control: agents: expected keys and values, found"),
        ("rate_min_hz: 20", "control: rate_min_hz, rate_max_hz, 1000 must rise"),
    ],
)
def test_invalid_settings_are_named(text: str, said: str) -> None:
    with pytest.raises(ConfigError) as error:
        settings.load_config(f"control: {{{text}}}")
    assert said in str(error.value)


@given(delays, errors, st.sampled_from(AgentKind))
def test_attribution_is_to_the_larger_loss(delay_ms: float, error_cm: float, kind: AgentKind) -> None:
    needs = QoeParameters.from_config(ControlConfig(), kind)
    found = qoe_factors(delay_ms, error_cm, needs)
    assert math.prod(found) == qoe(delay_ms, error_cm, needs)
    assert -1 <= found.error_attribution <= 1
    assert (found.error_attribution > 0) == (found.error < found.delay)


def test_attribution_by_hand() -> None:
    """e^-1 is lost by delay, 1 - e^-1 is left by error: ln is -1 and -0.45868."""
    found = qoe_factors(120, 0.5, AR)
    assert found.delay == pytest.approx(math.exp(-1), abs=1e-15)
    assert found.error_attribution == pytest.approx(
        (0.4586751453870819 - 1) / (0.4586751453870819 + 1), abs=1e-12
    )
    assert qoe_factors(20, 0.5, AR).error_attribution == 1
    assert qoe_factors(75, 0.5, ROBOT).error_attribution == -1
