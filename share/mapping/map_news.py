"""Conversions between the mapper's keyframes and the records that the map file keeps."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from share.mapping.atlas import RestoredKeyframe
from share.mapping.culling import OdometryLink, RemovedKeyframe
from share.mapping.loops import KeyframeKey
from share.mapping.map_changes import (
    MapChange,
    RemoveKeyframes,
    SaveLink,
    SaveLoop,
    StoredKeyframe,
    odometry_link,
)


def restored_keyframe(stored: StoredKeyframe, links: Mapping[KeyframeKey, SaveLink]) -> RestoredKeyframe:
    """Convert a stored keyframe with its odometry edge to the atlas's form."""
    edge, as_sent = odometry_link(stored, links), stored.keyframe_key not in links
    sent = stored.keyframe
    return RestoredKeyframe(
        stored.keyframe_key, stored.segment_name, stored.ordinal, sent, edge.T_ref_body, edge.cov, as_sent
    )


def stored_link(link: OdometryLink) -> SaveLink:
    """Convert an odometry link to the record that the map file keeps."""
    reference = -1 if link.reference is None else link.reference.id
    return SaveLink(link.key, reference, link.T_ref_body, link.cov)


def removal_changes(removed: Iterable[RemovedKeyframe]) -> list[MapChange]:
    """Convert removals to changes, in their order: a link may lead to a keyframe that goes next."""
    changes: list[MapChange] = []
    for keyframe in removed:
        if keyframe.link is not None:
            changes.append(stored_link(keyframe.link))
        changes += [RemoveKeyframes((keyframe.key,)), *(SaveLoop(loop) for loop in keyframe.moved_loops)]
    return changes
