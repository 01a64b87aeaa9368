"""The rooms that come with SHARE, by name: seeded layouts."""

from __future__ import annotations

from share.lab.emulate.world.scenes.table import SCENES, Scene, layout

__all__ = ["SCENES", "Scene", "layout"]
