"""Keyframes whose reference is lost are reconnected, and no more certain than before."""

from dataclasses import replace

import numpy as np
from helpers.map_changes import ANN, BOB, kept_keyframe, pose

from share.geometry import se3
from share.mapping.loops import KeyframeKey
from share.mapping.map_changes import SaveLink
from share.store.loading import repair_references


def test_intact_keyframes_stay_unchanged():
    frames = [kept_keyframe(key, i) for i in range(4) for key in (ANN, BOB)]
    whole = repair_references(frames, {})
    assert (whole.keyframes, whole.links, whole.reconnected_count) == (tuple(frames), {}, 0)


def test_a_gap_is_bridged_by_odometry():
    frames = [kept_keyframe(ANN, i) for i in (0, 1, 4, 5)]
    whole = repair_references(frames, {})
    tied = whole.keyframes[2].keyframe
    assert (whole.reconnected_count, tied.reference, tied.id) == (1, 1, 4)
    assert np.allclose(pose(1) @ tied.T_ref_body, pose(4), atol=1e-12)
    assert tied.predecessor == frames[2].keyframe.predecessor
    assert whole.keyframes[3] is frames[3]


def test_a_bridged_step_has_the_covariance_of_the_lost_steps():
    sent = kept_keyframe(ANN, 4)
    whole = repair_references([kept_keyframe(ANN, 1), sent], {}).keyframes[1].keyframe
    own = sent.keyframe
    expected = 2 * se3.compose_cov(own.T_ref_body, own.cov, 0 * own.cov) + own.cov  # steps 1-2, 2-3; then 3-4
    assert np.allclose(whole.cov, expected, rtol=1e-9)
    assert np.linalg.eigvalsh(whole.cov - own.cov)[0] > 0


def test_without_an_earlier_keyframe_one_begins_its_segment():
    frames = [kept_keyframe(ANN, 0), kept_keyframe(ANN, 7, stretch=1), kept_keyframe(BOB, 3)]
    whole = repair_references(frames, {})
    for found in whole.keyframes[1:]:
        assert found.keyframe.reference == -1
        assert np.array_equal(found.keyframe.T_ref_body, found.keyframe.T_odom_body)


def test_a_link_is_repaired_as_a_link():
    """Its covariance is the graph's, not the agent's; the keyframe stays as it was sent."""
    link = SaveLink(KeyframeKey(ANN, 4), 2, pose(2), np.eye(6))
    gone = replace(link, key=KeyframeKey(ANN, 9))
    whole = repair_references(
        [kept_keyframe(ANN, 0), kept_keyframe(ANN, 4)], {link.key: link, gone.key: gone}
    )
    assert whole.links.keys() == {KeyframeKey(ANN, 4)}
    assert whole.links[KeyframeKey(ANN, 4)].reference == 0
    assert np.allclose(
        whole.links[KeyframeKey(ANN, 4)].T_ref_body, se3.inverse(pose(0)) @ pose(4), atol=1e-12
    )
    assert whole.keyframes[1].keyframe.reference == 3
