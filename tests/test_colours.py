"""Colours: one of each agent and policy, wherever it is drawn."""

from __future__ import annotations

import cv2
import numpy as np

from share.colours import (
    AGENT_COLOURS,
    POLICY_COLOURS,
    agent_colour,
    agent_colours,
    hex_colour,
    series_colours,
)
from share.config import POLICY_NAMES
from share.runtime.status_page import status_page


def test_every_policy_has_a_colour_of_its_own() -> None:
    assert set(POLICY_COLOURS) == set(POLICY_NAMES)
    assert len(set(POLICY_COLOURS.values())) == len(POLICY_COLOURS)
    assert len(set(AGENT_COLOURS)) == len(AGENT_COLOURS)


def test_thirty_agents_have_colours_that_can_be_told_apart() -> None:
    rgb = np.array([[agent_colour(k) for k in range(30)]], np.float32) / 255
    lab = cv2.cvtColor(rgb, cv2.COLOR_RGB2Lab)[0]
    distances = np.linalg.norm(lab[:, None] - lab[None], axis=2)
    assert distances[np.triu_indices(30, 1)].min() > 12  # CIE76; 2.3 is just noticeable


def test_a_policy_keeps_its_colour_whoever_stands_beside_it() -> None:
    alone, beside = series_colours(["share"]), series_colours(["basalt", "linear", "share"])
    assert alone["share"] == beside["share"] == hex_colour(POLICY_COLOURS["share"])
    assert beside["basalt"] == series_colours(["basalt", "openvins"])["basalt"]


def test_agents_are_coloured_in_order_and_the_page_does_the_same() -> None:
    colours = agent_colours(["ann", "bob"])
    assert colours == {"ann": hex_colour(agent_colour(0)), "bob": hex_colour(agent_colour(1))}
    assert agent_colour(len(AGENT_COLOURS)) == agent_colour(0)
    page = status_page().decode()
    assert all(hex_colour(colour) in page for colour in AGENT_COLOURS)
    assert "%COLOURS%" not in page
