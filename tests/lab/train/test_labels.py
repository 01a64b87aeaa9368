"""A label has the stamp, error and picture of its keyframe's own frame."""

import cv2
import pytest

from share.config import Config
from share.lab.train.labels import labelled_keyframes
from share.metrics.local_error import LocalError
from share.runtime.pipeline import make_tracker, read_frames
from share.runtime.source import open_source
from share.sensors.sequencer import SequencerCounters


@pytest.mark.long
def test_a_label_is_that_of_the_keyframes_own_frame(plain_session):
    source = open_source(f"{plain_session}/ar1")
    tracker, error = make_tracker(source.rig, Config()), LocalError(source.truth())
    own = []
    for frame in read_frames(source, Config(), SequencerCounters()):
        result = tracker.track(frame)
        error_cm = error.update(frame.stamp_ns, result.T_odom_body, result.new_segment)
        if result.keyframe_ready:
            tracker.make_keyframe(frame)
            own.append((frame, error_cm))
    labels = list(labelled_keyframes(source, Config()))
    assert len(labels) >= 2
    assert [stamp_ns for stamp_ns, *_ in labels] == [frame.stamp_ns for frame, _ in own]
    for (_, error_cm, found), (frame, own_cm) in zip(labels, own, strict=True):
        assert own_cm is None or error_cm == own_cm
        thumbnail = cv2.resize(frame.image0, (320, 240), interpolation=cv2.INTER_AREA)
        assert (found.picture == cv2.resize(thumbnail, (128, 128), interpolation=cv2.INTER_AREA)).all()
