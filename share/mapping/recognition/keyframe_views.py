"""The views and images of the map's keyframes, by node id, and the index that finds similar ones."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import KeysView

from share.geometry.camera import Rig
from share.mapping.recognition.index import PlaceIndex
from share.mapping.recognition.patch_alignment import ImageView
from share.mapping.recognition.verification import CameraView
from share.types import Keyframe, KeyframeImage, View

_DECODED_IMAGES = 32  # kept decoded, with their patches; the others stay compressed


class KeyframeViews:
    """Views of keyframes by node id, and the index that finds similar ones.

    A keyframe that came with its ORB features is indexed at once; one with an image has an empty view until
    it is described (`share.mapping.steps.DescribeStep`).
    """

    def __init__(self) -> None:
        self.by_node: dict[int, CameraView] = {}
        self.index = PlaceIndex()
        self._images: dict[int, tuple[KeyframeImage, Rig]] = {}
        self._decoded: OrderedDict[int, ImageView] = OrderedDict()  # the last used is last
        self._undescribed: dict[int, None] = {}
        self._restored: list[tuple[int, View]] = []

    def add(self, node_id: int, keyframe: Keyframe, rig: Rig) -> None:
        self._add(node_id, keyframe, rig)
        if len(keyframe.view):
            self.index.add(node_id, keyframe.view.descriptors)

    def add_restored(self, node_id: int, keyframe: Keyframe, rig: Rig) -> None:
        """Add a restored keyframe; its view is indexed at `index_restored`, so that a restart is quick."""
        self._add(node_id, keyframe, rig)
        if len(keyframe.view):
            self._restored.append((node_id, keyframe.view))

    def _add(self, node_id: int, keyframe: Keyframe, rig: Rig) -> None:
        self.by_node[node_id] = CameraView(keyframe.view, rig.cam0.focal, rig.T_body_cam0, keyframe.up)
        if len(keyframe.image.jpeg):
            self._images[node_id] = keyframe.image, rig
            if not len(keyframe.view):
                self._undescribed[node_id] = None

    def index_restored(self) -> None:
        """Index the views of restored keyframes."""
        for node_id, view in self._restored:
            self.index.add(node_id, view.descriptors)
        self._restored = []

    def with_image(self) -> KeysView[int]:
        """Return the keyframes with an image."""
        return self._images.keys()

    def image(self, node_id: int) -> ImageView | None:
        """Return a keyframe's image; None without one."""
        if node_id not in self._images:
            return None
        if node_id not in self._decoded:
            image, rig = self._images[node_id]
            self._decoded[node_id] = ImageView(image, rig.cam0, rig.T_body_cam0)
        self._decoded.move_to_end(node_id)
        if len(self._decoded) > _DECODED_IMAGES:
            self._decoded.popitem(last=False)
        return self._decoded[node_id]

    def undescribed_image(self, node_id: int) -> ImageView | None:
        """Return the image of a keyframe that is to be described; None if it is none."""
        return self.image(node_id) if node_id in self._undescribed else None

    def next_undescribed(self) -> int | None:
        """Return the newest keyframe that is to be described."""
        return next(reversed(self._undescribed), None)

    def describe(self, node_id: int, view: View) -> None:
        """Set the view of a keyframe, and index it, unless it was removed meanwhile."""
        self._undescribed.pop(node_id, None)
        if (known := self.by_node.get(node_id)) is not None:
            self.by_node[node_id] = CameraView(view, known.focal, known.T_body_cam0, known.up)
            self.index.add(node_id, view.descriptors)

    def remove(self, node_id: int) -> None:
        is_indexed = node_id not in self._undescribed and (
            node_id in self._images or len(self.by_node[node_id].view) > 0
        )
        if is_indexed:
            self.index.remove(node_id)
        del self.by_node[node_id]
        for per_node in (self._images, self._decoded, self._undescribed):
            per_node.pop(node_id, None)
