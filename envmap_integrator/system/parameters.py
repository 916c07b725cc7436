"""Validated access to plugin parameters: ``props.get`` checks neither type nor range."""

from __future__ import annotations

import math

import mitsuba as mi
import numpy as np


class Parameters:
    """Reads the properties of one plugin; every complaint names the plugin and the property.

    Properties that nothing reads are rejected by name where plugins are registered.
    """

    def __init__(self, props: mi.Properties):
        self._props = props
        self.owner = f'{props.plugin_name()} "{props.id()}"' if props.id() else props.plugin_name()

    def integer(
        self, name: str, default: int | None, low: int, high: int = 2**31 - 1
    ) -> int | None:
        """An integer of ``low`` to ``high``; None if it isn't given and there is no default."""
        if default is None and name not in self._props:
            return None
        value = self._props.get(name, default)
        if isinstance(value, bool) or not isinstance(value, int):
            raise TypeError(f'{self.owner}: "{name}" must be an integer, not {value!r}')
        return self._in_range(name, value, low, high)

    def power_of_two(self, name: str, default: int | None, low: int, high: int) -> int | None:
        """A power of two of ``low`` to ``high``, or None likewise."""
        value = self.integer(name, default, low, high)
        if value is not None and value & (value - 1):
            raise ValueError(f'{self.owner}: "{name}" must be a power of two, not {value}')
        return value

    def number(
        self, name: str, default: float | None, low: float, high: float = math.inf
    ) -> float | None:
        """A finite number of ``low`` to ``high``, or None likewise."""
        if default is None and name not in self._props:
            return None
        value = self._props.get(name, default)
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise TypeError(f'{self.owner}: "{name}" must be a number, not {value!r}')
        return float(self._in_range(name, value, low, high))

    def flag(self, name: str, default: bool) -> bool:
        """True or false."""
        value = self._props.get(name, default)
        if not isinstance(value, bool):
            raise TypeError(f'{self.owner}: "{name}" must be true or false, not {value!r}')
        return value

    def choice(self, name: str, default: str, choices: tuple[str, ...]) -> str:
        """One of a few words."""
        value = self._props.get(name, default)
        if value not in choices:
            allowed = " or ".join(f'"{choice}"' for choice in choices)
            raise ValueError(f'{self.owner}: "{name}" must be {allowed}, not {value!r}')
        return value

    def text(self, name: str, default: str = "") -> str:
        """Any string."""
        value = self._props.get(name, default)
        if not isinstance(value, str):
            raise TypeError(f'{self.owner}: "{name}" must be a string, not {value!r}')
        return value

    def names(self, name: str) -> tuple[str, ...]:
        """Ids separated by commas; none if it isn't given."""
        text = self.text(name)
        found = tuple(part.strip() for part in text.split(",") if part.strip())
        if name in self._props and not found:
            raise ValueError(f'{self.owner}: "{name}" must list ids, not {text!r}')
        return found

    def point(self, name: str) -> tuple[float, ...] | None:
        """Three finite numbers, or text that lists them; None if it isn't given."""
        if name not in self._props:
            return None
        value = self._props.get(name)
        try:
            point = tuple(map(float, value.split(",") if isinstance(value, str) else value))
        except (TypeError, ValueError):
            point = ()
        if len(point) != 3 or not all(map(math.isfinite, point)):
            raise ValueError(f'{self.owner}: "{name}" must be three numbers, not {value!r}')
        return point

    def rotation(self, name: str) -> np.ndarray:
        """Rotation, [3, 3], of a transform that may also mirror and scale evenly and move."""
        value = self._props.get(name, mi.ScalarTransform4f())
        matrix = np.array(getattr(value, "matrix", np.zeros((4, 4))), np.float64)[:3, :3]
        turned = matrix / max(np.linalg.norm(matrix, axis=0).max(), 1e-30)
        if not np.allclose(turned.T @ turned, np.eye(3), atol=1e-4):
            shown = " ".join(f"{x:g}" for x in matrix.ravel()) if matrix.any() else repr(value)
            raise ValueError(
                f'{self.owner}: "{name}" must rotate, without stretching or shearing, not {shown}'
            )
        return turned

    def _in_range(self, name, value, low, high):
        if not (low <= value <= high and math.isfinite(value)):
            upper = f" and at most {high:.10g}" if math.isfinite(high) else ""
            raise ValueError(f'{self.owner}: "{name}" must be at least {low:g}{upper}, not {value}')
        return value
