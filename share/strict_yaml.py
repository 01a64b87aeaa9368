"""A YAML loader for files of settings from anywhere: each key once, and bounds on what a file may ask for.

An alias counts as all that it stands for, since whoever goes through the result meets it again and again:
ten lists of ten aliases each are 10^10 values. Written numbers are bounded too: Python reads an integer of a
million digits in minutes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import yaml

_MAX_DEPTH = 40  # lists and mappings in each other; a session with its recipe has 8
_MAX_VALUES = 200_000  # values, aliases counted in full; a session of ten agents has 5,000
_MAX_NUMBER_LENGTH = 60  # characters of a number or a date
_MERGE_TAG = "tag:yaml.org,2002:merge"  # of `<<`
_BOUNDED_TAGS = ("int", "float", "timestamp", "bool")


class StrictLoader(yaml.SafeLoader):
    """Raises yaml.MarkedYAMLError for what it refuses."""

    def __init__(self, stream: Any) -> None:
        super().__init__(stream)
        self._depth = self._values = 0
        self._sizes: dict[str, int] = {}  # values below each anchor that is complete

    def compose_node(self, parent: Any, index: Any) -> Any:
        event = self.peek_event()  # type: ignore[no-untyped-call]
        anchor, values_before = event.anchor, self._values
        if isinstance(event, yaml.AliasEvent):
            self._count_values(self._alias_size(event), event)
            return super().compose_node(parent, index)
        self._count_values(1, event)
        self._depth += 1
        if self._depth > _MAX_DEPTH:
            raise _error(f"lists and mappings are nested deeper than {_MAX_DEPTH}", event.start_mark)
        node = super().compose_node(parent, index)
        self._depth -= 1
        if anchor is not None:
            self._sizes[anchor] = self._values - values_before
        return node

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key, _ in node.value if isinstance(node, yaml.MappingNode) else ():
            if isinstance(key, yaml.ScalarNode) and key.tag != _MERGE_TAG:
                if (key.tag, key.value) in seen:
                    raise _error(f"key '{key.value}' for the second time", key.start_mark)
                seen.add((key.tag, key.value))
        return super().construct_mapping(node, deep)

    def _count_values(self, values: int, event: Any) -> None:
        self._values += values
        if self._values > _MAX_VALUES:
            raise _error(f"has more than {_MAX_VALUES:,} values, aliases counted in full", event.start_mark)

    def _alias_size(self, event: Any) -> int:
        if event.anchor in self.anchors and event.anchor not in self._sizes:
            raise _error(f"alias '{event.anchor}' stands within what it stands for", event.start_mark)
        return self._sizes.get(event.anchor, 1)  # one that is not known is refused by PyYAML


def _bounded_constructor(constructor: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """A constructor of numbers or dates that raises nothing but yaml.MarkedYAMLError."""

    def construct_bounded(self: Any, node: Any) -> Any:
        if isinstance(node, yaml.ScalarNode) and len(node.value) > _MAX_NUMBER_LENGTH:
            raise _error(f"a number of {len(node.value)} characters", node.start_mark)
        try:
            return constructor(self, node)
        except (ValueError, OverflowError, IndexError, KeyError, AttributeError):
            raise _error(f"'{node.value}' is not what its tag says", node.start_mark) from None

    return construct_bounded


def _error(problem: str, mark: Any) -> yaml.MarkedYAMLError:
    return yaml.MarkedYAMLError(problem=problem, problem_mark=mark)


for _tag in (f"tag:yaml.org,2002:{name}" for name in _BOUNDED_TAGS):
    StrictLoader.add_constructor(_tag, _bounded_constructor(yaml.SafeLoader.yaml_constructors[_tag]))
