"""What of the mapper's map is to be kept, and what is found again, each as the other side has it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from share.mapping.atlas import Placed
from share.mapping.changes import Change, KeepLink, KeepLoop, KeptKeyframe, Retire, edge_to
from share.mapping.culling import Link, TakenOut
from share.mapping.loops import Key


def placed_again(found: KeptKeyframe, links: Mapping[Key, KeepLink]) -> Placed:
    edge, as_sent = edge_to(found, links), found.at not in links
    own = found.keyframe
    return Placed(found.at, found.stretch, found.ordinal, own, edge.T_ref_body, edge.cov, as_sent)


def kept_link(link: Link) -> KeepLink:
    reference = -1 if link.reference is None else link.reference.id
    return KeepLink(link.key, reference, link.T_ref_body, link.cov)


def changes_of(taken: Iterable[TakenOut]) -> list[Change]:
    """In the order in which they happened: a link may lead to one that goes next."""
    changes: list[Change] = []
    for out in taken:
        if out.link is not None:
            changes.append(kept_link(out.link))
        changes += [Retire((out.key,)), *(KeepLoop(loop) for loop in out.moved)]
    return changes
