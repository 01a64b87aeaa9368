"""The views and images of the map's keyframes, by node id, and the index that finds similar ones."""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Callable, Iterator, KeysView, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol, TypeVar

from share.geometry.camera import Rig
from share.mapping.loops import KeyframeKey
from share.mapping.recognition.index import U32, PlaceIndex
from share.mapping.recognition.patch_alignment import ImageView
from share.mapping.recognition.verification import CameraView
from share.types import F64, U8, Keyframe, KeyframeImage, View
from share.vision.packed_view import PackedView

T = TypeVar("T")

_DECODED_IMAGES = 32  # kept decoded, with their patches; the others stay compressed
_KEPT_JPEGS, _KEPT_VIEWS = 500, 1000  # kept in memory where the map file has them too
_RESTORED_STRIDE = 16  # restored keyframes are indexed in so many passes: each goes over the whole map
_RESTORED_PER_SLICE = 16
_NO_VIEW = View.empty()  # one for all, since it takes 500 bytes


class ArchiveReader(Protocol):
    """Images and views in the map file, as far as they are there already: None, False where not."""

    def jpeg(self, key: KeyframeKey) -> U8 | None: ...

    def view(self, key: KeyframeKey) -> PackedView | None: ...

    def has_jpeg(self, key: KeyframeKey) -> bool: ...

    def has_view(self, key: KeyframeKey) -> bool: ...


class IndexEntry(NamedTuple):
    """A restored keyframe that is to be indexed."""

    node_id: int
    descriptors: U8


@dataclass(frozen=True, eq=False)
class _ResidentKeyframe:
    """What always stays in memory of a keyframe.

    view: as the agent sent it; mostly empty. surfaces: its image without the JPEG.
    """

    key: KeyframeKey
    rig: Rig
    up: F64
    view: View
    surfaces: KeyframeImage
    has_image: bool


class KeyframeViews:
    """Views of keyframes by node id, and the index that finds similar ones.

    A keyframe that came with its ORB features is indexed at once; one with an image has an empty view until
    it is described (`share.mapping.steps.DescribeStep`). by_node: views, unpacked or read when asked for.
    archive: what is in it is forgotten here once it was not used for long.
    """

    def __init__(
        self,
        archive: ArchiveReader | None = None,
        on_indexed: Callable[[KeyframeKey, U32], None] | None = None,
    ) -> None:
        """on_indexed: called with each keyframe that is described, and the words of its descriptors."""
        self.index = PlaceIndex()
        self._on_indexed = on_indexed
        self._archive = archive
        self._known: dict[int, _ResidentKeyframe] = {}
        self.by_node: Mapping[int, CameraView] = _LazyViews(self._known, self._camera_view)
        self._images: dict[int, None] = {}  # keyframes with an image
        self._jpegs: OrderedDict[int, U8] = OrderedDict()  # the last used is last, also below
        self._views: OrderedDict[int, PackedView] = OrderedDict()
        self._decoded: OrderedDict[int, ImageView] = OrderedDict()
        self._undescribed: dict[int, None] = {}
        self._restored: deque[int] = deque()
        self._indexed: set[int] = set()

    def add(self, node_id: int, key: KeyframeKey, keyframe: Keyframe, rig: Rig) -> None:
        self._add(node_id, key, keyframe, rig, len(keyframe.image.jpeg) > 0)
        if len(keyframe.view):
            self._add_to_index(node_id, self.index.words(keyframe.view.descriptors))

    def restore(self, keyframes: Sequence[tuple[int, KeyframeKey, Keyframe, Rig]]) -> None:
        """Add restored keyframes; `next_restored` says which to index next, so that a restart is quick.

        JPEGs are in the archive, but those of an older map file.
        """
        for node_id, key, keyframe, rig in keyframes:
            self._add(node_id, key, keyframe, rig, has_image=len(keyframe.image.uv) > 0)
        for first in range(_RESTORED_STRIDE):
            self._restored.extend(node_id for node_id, *_ in keyframes[first::_RESTORED_STRIDE])

    def _add(self, node_id: int, key: KeyframeKey, keyframe: Keyframe, rig: Rig, has_image: bool) -> None:
        image, view = keyframe.image, keyframe.view if len(keyframe.view) else _NO_VIEW
        self._known[node_id] = _ResidentKeyframe(key, rig, keyframe.up, view, image.without_jpeg(), has_image)
        if has_image:
            self._images[node_id] = None
            if not len(keyframe.view):
                self._undescribed[node_id] = None
        if len(image.jpeg):
            self._keep(self._jpegs, node_id, image.jpeg)

    # Restored keyframes

    def next_restored(self) -> list[IndexEntry]:
        """Return the restored keyframes to index next, with views from the archive; those without one are to
        be described."""
        out: list[IndexEntry] = []
        while self._restored and len(out) < _RESTORED_PER_SLICE:
            node_id = self._restored.popleft()
            if node_id not in self._known or node_id in self._indexed:
                continue
            view = self._known[node_id].view if len(self._known[node_id].view) else self._packed(node_id)
            if view is not None:
                self._undescribed.pop(node_id, None)
                out.append(IndexEntry(node_id, view.descriptors))
        return out

    def index_words(self, words: Mapping[int, U32]) -> None:
        """Index restored keyframes by their words, unless they were removed meanwhile."""
        for node_id, of_view in words.items():
            if node_id in self._known and node_id not in self._indexed:
                self._add_to_index(node_id, of_view)

    def _add_to_index(self, node_id: int, words: U32) -> None:
        self._indexed.add(node_id)
        self.index.add_words(node_id, words)
        if self._on_indexed is not None:
            self._on_indexed(self._known[node_id].key, words)

    # Images

    def with_image(self) -> KeysView[int]:
        """Return the keyframes with an image."""
        return self._images.keys()

    def image(self, node_id: int) -> ImageView | None:
        """Return a keyframe's image; None without one."""
        if node_id not in self._images:
            return None
        if node_id not in self._decoded:
            jpeg, known = self._jpeg(node_id), self._known[node_id]
            if jpeg is None:
                return None
            source = replace(known.surfaces, jpeg=jpeg)
            self._decoded[node_id] = ImageView(source, known.rig.cam0, known.rig.T_body_cam0)
        self._decoded.move_to_end(node_id)
        if len(self._decoded) > _DECODED_IMAGES:
            self._decoded.popitem(last=False)
        return self._decoded[node_id]

    def _jpeg(self, node_id: int) -> U8 | None:
        jpeg = self._jpegs.get(node_id)
        if jpeg is None and self._archive is not None:
            jpeg = self._archive.jpeg(self._known[node_id].key)
        if jpeg is not None:
            self._keep(self._jpegs, node_id, jpeg)
        return jpeg

    # Views

    def undescribed_image(self, node_id: int) -> ImageView | None:
        """Return the image of a keyframe that is to be described; None if it is none."""
        return self.image(node_id) if node_id in self._undescribed else None

    def next_undescribed(self) -> int | None:
        """Return the newest keyframe that is to be described; those whose image is lost are not."""
        while (node_id := next(reversed(self._undescribed), None)) is not None:
            if self.image(node_id) is not None:
                return node_id
            del self._undescribed[node_id], self._images[node_id]
        return None

    def describe(self, node_id: int, view: View) -> PackedView | None:
        """Set the view of a keyframe, index it, and return it as it is kept; None if the keyframe was removed
        meanwhile."""
        self._undescribed.pop(node_id, None)
        if node_id not in self._known:
            return None
        packed = PackedView.pack(view)
        self._keep(self._views, node_id, packed)
        self._add_to_index(node_id, self.index.words(packed.descriptors))
        return packed

    def _camera_view(self, node_id: int) -> CameraView:
        known = self._known[node_id]
        view = known.view
        if not len(view) and (packed := self._packed(node_id)) is not None:
            view = packed.unpack()
        return CameraView(view, known.rig.cam0.focal, known.rig.T_body_cam0, known.up)

    def _packed(self, node_id: int) -> PackedView | None:
        """The view of a keyframe's image; None if it is not described."""
        view = self._views.get(node_id)
        if view is None and self._archive is not None and node_id in self._images:
            view = self._archive.view(self._known[node_id].key)
        if view is not None:
            self._keep(self._views, node_id, view)
        return view

    # Memory

    def remove(self, node_id: int) -> None:
        if node_id in self._indexed:
            self._indexed.remove(node_id)
            self.index.remove(node_id)
        del self._known[node_id]
        for per_node in (self._images, self._jpegs, self._views, self._decoded, self._undescribed):
            per_node.pop(node_id, None)

    def _keep(self, kept: OrderedDict[int, T], node_id: int, value: T) -> None:
        """Keep the JPEG or view of a keyframe, and forget the one not used for longest if there are many."""
        kept[node_id] = value
        kept.move_to_end(node_id)
        if self._archive is None:
            return
        is_view = kept is self._views
        has = self._archive.has_view if is_view else self._archive.has_jpeg
        if len(kept) > (_KEPT_VIEWS if is_view else _KEPT_JPEGS):
            oldest = next(iter(kept))
            if has(self._known[oldest].key):
                del kept[oldest]
            else:  # not written yet
                kept.move_to_end(oldest)


class _LazyViews(Mapping[int, CameraView]):
    """The views of all known keyframes, each made when it is asked for."""

    def __init__(self, known: Mapping[int, object], make: Callable[[int], CameraView]) -> None:
        self._known, self._make = known, make

    def __getitem__(self, node_id: int) -> CameraView:
        return self._make(node_id)

    def __contains__(self, node_id: object) -> bool:
        return node_id in self._known

    def __iter__(self) -> Iterator[int]:
        return iter(self._known)

    def __len__(self) -> int:
        return len(self._known)
