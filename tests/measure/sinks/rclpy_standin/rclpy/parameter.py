"""Parameters, as rclpy.parameter has them: of one type each, lists of one type."""

from __future__ import annotations

from typing import Any


class Parameter:
    def __init__(self, name: str, *, value: Any) -> None:
        assert name, name
        kinds = {type(one) for one in value} if isinstance(value, list) else {type(value)}
        assert len(kinds) <= 1, value
        assert kinds <= {bool, int, float, str}, value
        self.name, self.value = name, value
