from __future__ import annotations

import numpy as np

from share.geometry import se3
from share.site.building import BuildingGraph, RoomMap
from share.types import Correction

RNG = np.random.default_rng(5)
ROOMS = {
    RoomMap(name, f"{name}-1/0"): se3.exp(np.array([0, 0, turn, x, y, 0.0]))
    for name, turn, x, y in (
        ("hall", 0.0, 0, 0),
        ("lab", 1.0, 6, 1),
        ("kitchen", -2.0, 3, 7),
        ("attic", 0.5, 9, 9),
    )
}  # T_building_map
HALL, LAB, KITCHEN, ATTIC = ROOMS
COV = np.diag([1e-5] * 3 + [1e-4] * 3)


def correction(where: RoomMap, T_building_odom, noise: float = 0.0) -> Correction:
    T = se3.inverse(ROOMS[where]) @ T_building_odom @ se3.exp(noise * RNG.normal(0, 1, 6))
    return Correction(se3.orthonormal(T), COV, where.map_id, 0, 0)


def cross(graph: BuildingGraph, a: RoomMap, b: RoomMap, noise: float = 0.0) -> None:
    T_building_odom = se3.exp(RNG.normal(0, 1, 6))
    graph.add_crossing(a, correction(a, T_building_odom, noise), b, correction(b, T_building_odom, noise))


def error_m(graph: BuildingGraph, one: RoomMap) -> float:
    pose = graph.poses[one]
    true = se3.inverse(ROOMS[pose.reference]) @ ROOMS[one]
    return float(np.linalg.norm((se3.inverse(true) @ pose.T_building_map)[:3, 3]))


def test_rooms_that_doors_tie_have_one_frame():
    graph = BuildingGraph()
    cross(graph, HALL, LAB)
    cross(graph, KITCHEN, LAB)
    assert {pose.reference for pose in graph.poses.values()} == {HALL}
    assert max(error_m(graph, one) for one in graph.poses) < 1e-9


def test_rooms_without_a_door_have_frames_of_their_own():
    graph = BuildingGraph()
    cross(graph, HALL, LAB)
    cross(graph, KITCHEN, ATTIC)
    assert graph.poses[LAB].reference == HALL
    assert graph.poses[ATTIC].reference == KITCHEN
    cross(graph, LAB, KITCHEN)
    assert {pose.reference for pose in graph.poses.values()} == {HALL}
    assert max(error_m(graph, one) for one in graph.poses) < 1e-9


def test_more_crossings_and_a_way_round_are_truer():
    once, often = [], []
    for _ in range(10):
        graph = BuildingGraph()
        for a, b in ((HALL, LAB), (LAB, KITCHEN)):
            cross(graph, a, b, 0.03)
        once.append(error_m(graph, KITCHEN))
        for a, b in 4 * ((HALL, LAB), (LAB, KITCHEN), (KITCHEN, HALL)):
            cross(graph, a, b, 0.03)
        often.append(error_m(graph, KITCHEN))
    assert np.median(often) < 0.6 * np.median(once)


def test_one_wrong_crossing_does_not_bend_the_building():
    graph = BuildingGraph()
    for _ in range(4):
        for a, b in ((HALL, LAB), (LAB, KITCHEN), (KITCHEN, HALL)):
            cross(graph, a, b, 0.005)
    wrong = se3.exp(np.array([0, 0, 1.0, 3, 0, 0]))
    T = se3.exp(RNG.normal(0, 1, 6))
    graph.add_crossing(HALL, correction(HALL, T @ wrong), LAB, correction(LAB, T))
    assert max(error_m(graph, one) for one in graph.poses) < 0.05


def test_maps_that_are_gone_are_forgotten():
    graph = BuildingGraph()
    cross(graph, HALL, LAB)
    cross(graph, LAB, KITCHEN)
    graph.keep({HALL, LAB}.__contains__)
    assert set(graph.poses) == {HALL, LAB}
    graph.keep({HALL, LAB, ATTIC}.__contains__)
    assert set(graph.poses) == {HALL, LAB}
    cross(graph, LAB, LAB)
    assert set(graph.poses) == {HALL, LAB}
