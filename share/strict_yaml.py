"""Load untrusted YAML: unique keys and limits on depth, size and numbers.

An alias counts as all values that it stands for, since a walk over the result visits them each time: ten
nested levels of ten aliases are 10^10 values. The length of numbers is limited: Python takes minutes to read
an integer of a million digits.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import yaml

from share.errors import ConfigError

_MAX_DEPTH = 40  # nested lists and mappings; a session with its recipe has 8
_MAX_VALUES = 200_000  # values, aliases counted in full; a session of ten agents has 5,000
_MAX_NUMBER_LENGTH = 60  # characters of a number or a date
_MERGE_TAG = "tag:yaml.org,2002:merge"  # of `<<`
_BOUNDED_TAGS = ("int", "float", "timestamp", "bool")


def load_yaml(text: str, where: str) -> Any:
    """Return the data of YAML text, as yaml.safe_load, within the limits. Raises ConfigError."""
    try:
        return yaml.load(text, StrictLoader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f", line {mark.line + 1}" if mark else ""
        reason = getattr(error, "problem", None) or str(error).splitlines()[0]
        raise ConfigError(f"{where}{line}: not valid YAML: {reason}") from None


class StrictLoader(yaml.SafeLoader):
    """Safe loader with limits. Raises yaml.MarkedYAMLError."""

    def __init__(self, stream: Any) -> None:
        super().__init__(stream)
        self._depth = self._values = 0
        self._sizes: dict[str, int] = {}  # values below each complete anchor

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
                    raise _error(f"duplicate key '{key.value}'", key.start_mark)
                seen.add((key.tag, key.value))
        return super().construct_mapping(node, deep)

    def _count_values(self, values: int, event: Any) -> None:
        self._values += values
        if self._values > _MAX_VALUES:
            raise _error(f"more than {_MAX_VALUES:,} values, aliases counted in full", event.start_mark)

    def _alias_size(self, event: Any) -> int:
        if event.anchor in self.anchors and event.anchor not in self._sizes:
            raise _error(f"alias '{event.anchor}' contains itself", event.start_mark)
        return self._sizes.get(event.anchor, 1)  # PyYAML refuses unknown ones


def _bounded_constructor(constructor: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """Return a constructor of numbers or dates that raises only yaml.MarkedYAMLError."""

    def construct_bounded(self: Any, node: Any) -> Any:
        if isinstance(node, yaml.ScalarNode) and len(node.value) > _MAX_NUMBER_LENGTH:
            raise _error(f"number of {len(node.value)} characters is too long", node.start_mark)
        try:
            return constructor(self, node)
        except (ValueError, OverflowError, IndexError, KeyError, AttributeError):
            raise _error(f"'{node.value}' does not match its tag", node.start_mark) from None

    return construct_bounded


def _error(problem: str, mark: Any) -> yaml.MarkedYAMLError:
    return yaml.MarkedYAMLError(problem=problem, problem_mark=mark)


for _tag in (f"tag:yaml.org,2002:{name}" for name in _BOUNDED_TAGS):
    StrictLoader.add_constructor(_tag, _bounded_constructor(yaml.SafeLoader.yaml_constructors[_tag]))
