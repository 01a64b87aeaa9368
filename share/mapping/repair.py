"""Repair of stored keyframes whose reference keyframe is missing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from share.mapping.culling import bridge_odometry
from share.mapping.loops import KeyframeKey
from share.mapping.map_changes import SaveLink, StoredKeyframe, odometry_link


@dataclass(frozen=True, eq=False)
class Repaired:
    """keyframes, links: with every reference present. reconnected_count: keyframes whose edge was rebuilt."""

    keyframes: tuple[StoredKeyframe, ...]
    links: dict[KeyframeKey, SaveLink]
    reconnected_count: int


def repair_references(keyframes: Sequence[StoredKeyframe], links: Mapping[KeyframeKey, SaveLink]) -> Repaired:
    """Connect each keyframe without its reference to the nearest earlier one on its segment.

    keyframes: in order of arrival. Both are in one odometry frame, so T_ref_body = T_odom_ref^-1 T_odom_body.
    Each missing step is given the covariance of the known one. A keyframe without an earlier one begins its
    segment.
    """
    out: list[StoredKeyframe] = []
    current_links = dict(links)
    newest_in_segment: dict[str, StoredKeyframe] = {}
    present_keys: set[KeyframeKey] = set()
    reconnected_count = 0
    for keyframe in keyframes:
        reference = (current_links.get(keyframe.keyframe_key) or keyframe.keyframe).reference
        if reference >= 0 and KeyframeKey(keyframe.run_key, reference) not in present_keys:
            edge = _reconnect(
                keyframe, odometry_link(keyframe, current_links), newest_in_segment.get(keyframe.segment_name)
            )
            if keyframe.keyframe_key in current_links:
                current_links[keyframe.keyframe_key] = edge
            else:
                keyframe = _with_edge(keyframe, edge)
            reconnected_count += 1
        out.append(keyframe)
        newest_in_segment[keyframe.segment_name] = keyframe
        present_keys.add(keyframe.keyframe_key)
    present_links = {key: link for key, link in current_links.items() if key in present_keys}
    return Repaired(tuple(out), present_links, reconnected_count)


def _reconnect(keyframe: StoredKeyframe, edge: SaveLink, previous: StoredKeyframe | None) -> SaveLink:
    if previous is None:
        return SaveLink(keyframe.keyframe_key, -1, keyframe.keyframe.T_odom_body, edge.cov)
    sent = replace(keyframe.keyframe, T_ref_body=edge.T_ref_body, cov=edge.cov)
    T, cov = bridge_odometry(previous.keyframe.T_odom_body, edge.reference - previous.keyframe_key.id, sent)
    return SaveLink(keyframe.keyframe_key, previous.keyframe_key.id, T, cov)


def _with_edge(keyframe: StoredKeyframe, edge: SaveLink) -> StoredKeyframe:
    """Return the keyframe as if its agent had sent this edge: the covariance is not yet inflated."""
    sent = replace(keyframe.keyframe, reference=edge.reference, T_ref_body=edge.T_ref_body, cov=edge.cov)
    return replace(keyframe, keyframe=sent)
