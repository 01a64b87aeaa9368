"""Keyframes whose reference is lost, tied to what is left of their stretch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from share.mapping.changes import KeepLink, KeptKeyframe, edge_to
from share.mapping.culling import across
from share.mapping.loops import Key


@dataclass(frozen=True, eq=False)
class Mended:
    """keyframes, links: with every reference there. tied: keyframes whose edge was made anew."""

    keyframes: tuple[KeptKeyframe, ...]
    links: dict[Key, KeepLink]
    tied: int


def mended(keyframes: Sequence[KeptKeyframe], links: Mapping[Key, KeepLink]) -> Mended:
    """Tie each keyframe whose reference is not there to the nearest before it on the same stretch.

    keyframes: in the order in which they came. Both stand in one odometry, so their relative pose is known:
    T_ref_body = T_odom_ref^-1 T_odom_body. Of the steps in between nothing is left; each is taken to be as
    uncertain as the step that is known. With none before it, a keyframe begins its stretch.
    """
    out: list[KeptKeyframe] = []
    ties = dict(links)
    newest: dict[str, KeptKeyframe] = {}
    there: set[Key] = set()
    tied = 0
    for keyframe in keyframes:
        reference = (ties.get(keyframe.at) or keyframe.keyframe).reference
        if reference >= 0 and Key(keyframe.key, reference) not in there:
            edge = _tie(keyframe, edge_to(keyframe, ties), newest.get(keyframe.stretch))
            if keyframe.at in ties:
                ties[keyframe.at] = edge
            else:
                keyframe = _as_sent(keyframe, edge)
            tied += 1
        out.append(keyframe)
        newest[keyframe.stretch] = keyframe
        there.add(keyframe.at)
    present = {key: link for key, link in ties.items() if key in there}
    return Mended(tuple(out), present, tied)


def _tie(keyframe: KeptKeyframe, edge: KeepLink, before: KeptKeyframe | None) -> KeepLink:
    if before is None:
        return KeepLink(keyframe.at, -1, keyframe.keyframe.T_odom_body, edge.cov)
    own = replace(keyframe.keyframe, T_ref_body=edge.T_ref_body, cov=edge.cov)
    T, cov = across(before.keyframe.T_odom_body, edge.reference - before.at.id, own)
    return KeepLink(keyframe.at, before.at.id, T, cov)


def _as_sent(keyframe: KeptKeyframe, edge: KeepLink) -> KeptKeyframe:
    """As if its agent had said so: the covariance is still the agent's, not yet the graph's."""
    own = replace(keyframe.keyframe, reference=edge.reference, T_ref_body=edge.T_ref_body, cov=edge.cov)
    return replace(keyframe, keyframe=own)
