"""Forms of values in a scene file, each with its range in words: numbers, vectors, colours, files, arrays.

Every form is a pydantic annotation that either returns the value or raises one error saying what is allowed. Numpy and
jax scalars and arrays pass as well as TOML's numbers and lists, so that scenes can be built from Python.
"""

from collections.abc import Callable, Sequence
from numbers import Integral, Real
from typing import Annotated, Any

import numpy as np
import trimesh
from pydantic import PlainValidator, WithJsonSchema
from pydantic_core import PydanticCustomError

from jaxvol.mesh_files import LARGEST_LENGTH

LARGEST = 1e30  # every other quantity: products with lengths stay clear of overflow


def refuse(expected: str) -> PydanticCustomError:
    """The error of a value that is not `expected`."""
    return PydanticCustomError("value", "must be {expected}", {"expected": expected})


def _range_in_words(low: float, high: float, open_low: bool, open_high: bool, largest: float) -> str:
    if low <= -largest and high >= largest:
        return f"between {low:g} and {high:g}" if largest < LARGEST else "finite"
    if high >= largest:
        return f"{'>' if open_low else '>='} {low:g} (and at most {high:g})"
    return f"in {'(' if open_low else '['}{low:g}, {high:g}{')' if open_high else ']'}"


def _plain(value: Any) -> Any:
    """Numpy or jax scalars and arrays as Python numbers and lists, everything else untouched."""
    if isinstance(value, np.generic) or (hasattr(value, "shape") and hasattr(value, "dtype")):
        return np.asarray(value).tolist()
    return value


def _is_number(value: Any) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)


def _within(low: float, high: float, open_low: bool, open_high: bool) -> Callable[[float], bool]:
    def test(x: float) -> bool:  # False for NaN
        return (x > low if open_low else x >= low) and (x < high if open_high else x <= high)

    return test


def number(
    *, low: float = -LARGEST, high: float = LARGEST, open_low: bool = False, open_high: bool = False, unit: str = ""
) -> Any:
    """A number in a range; `unit` is appended to the range in words."""
    words = f"a number {_range_in_words(low, high, open_low, open_high, LARGEST)}{unit}"
    within = _within(low, high, open_low, open_high)

    def check(value: Any) -> float:
        value = _plain(value)
        if not _is_number(value) or not within(value):
            raise refuse(words)
        return float(value)

    limits = {"exclusiveMinimum" if open_low else "minimum": low, "exclusiveMaximum" if open_high else "maximum": high}
    return Annotated[float, PlainValidator(check), WithJsonSchema({"type": "number"} | limits)]


def integer(*, low: int, high: int) -> Any:
    """A whole number in [low, high]."""

    def check(value: Any) -> int:
        value = _plain(value)
        if not isinstance(value, Integral) or isinstance(value, bool) or not low <= value <= high:
            raise refuse(f"a whole number in [{low}, {high}]")
        return int(value)

    return Annotated[int, PlainValidator(check), WithJsonSchema({"type": "integer", "minimum": low, "maximum": high})]


def _numbers(value: Any, count: int, test: Callable[[float], bool]) -> tuple[float, ...] | None:
    value = _plain(value)
    if not isinstance(value, Sequence) or isinstance(value, str) or len(value) != count:
        return None
    if not all(_is_number(x) and test(x) for x in value):
        return None
    return tuple(float(x) for x in value)


def _list_schema(count: int, low: float, high: float) -> dict:
    item = {"type": "number", "minimum": low, "maximum": high}
    return {"type": "array", "items": item, "minItems": count, "maxItems": count}


def vector(*, count: int = 3, nonzero: bool = False) -> Any:
    """`count` finite numbers; with `nonzero` a direction, whose length does not matter."""
    words = f"{count} finite numbers" + (", not all zero" if nonzero else f" of at most {LARGEST_LENGTH:g}")

    def check(value: Any) -> tuple[float, ...]:
        numbers = _numbers(value, count, _within(-LARGEST_LENGTH, LARGEST_LENGTH, False, False))
        if numbers is None or (nonzero and max(map(abs, numbers)) < 1e-18):
            raise refuse(words)
        return numbers

    schema = _list_schema(count, -LARGEST_LENGTH, LARGEST_LENGTH)
    return Annotated[tuple[float, ...], PlainValidator(check), WithJsonSchema(schema)]


def rgb(*, high: float = LARGEST) -> Any:
    """Linear RGB in [0, high]; one number stands for all three channels."""
    within = _within(0.0, high, False, False)
    words = f"a number or three numbers (linear RGB) {_range_in_words(0.0, high, False, False, LARGEST)}"

    def check(value: Any) -> tuple[float, float, float]:
        value = _plain(value)
        numbers = _numbers([value] * 3 if _is_number(value) else value, 3, within)
        if numbers is None:
            raise refuse(words)
        return numbers

    schema = {"anyOf": [{"type": "number", "minimum": 0.0, "maximum": high}, _list_schema(3, 0.0, high)]}
    return Annotated[tuple[float, float, float], PlainValidator(check), WithJsonSchema(schema)]


def scale() -> Any:
    """One number or three, none of them zero; negative ones mirror."""

    def check(value: Any) -> tuple[float, float, float]:
        value = _plain(value)
        numbers = _numbers([value] * 3 if _is_number(value) else value, 3, lambda x: 1e-12 <= abs(x) <= 1e12)
        if numbers is None:
            raise refuse("a number or three numbers of size in [1e-12, 1e12]")
        return numbers

    schema = {"anyOf": [{"type": "number"}, _list_schema(3, -1e12, 1e12)]}
    return Annotated[tuple[float, float, float], PlainValidator(check), WithJsonSchema(schema)]


def box() -> Any:
    """`[[x, y, z], [x, y, z]]`: lower and upper corner, every side longer than zero."""
    words = f"[[x, y, z], [x, y, z]], finite (at most {LARGEST_LENGTH:g}), the first corner below the second on every axis"

    def check(value: Any) -> tuple[tuple[float, ...], tuple[float, ...]]:
        value = _plain(value)
        corners = value if isinstance(value, Sequence) and not isinstance(value, str) and len(value) == 2 else (None, None)
        low, high = (_numbers(corner, 3, _within(-LARGEST_LENGTH, LARGEST_LENGTH, False, False)) for corner in corners)
        if low is None or high is None or not all(np.float32(a) < np.float32(b) for a, b in zip(low, high, strict=True)):
            raise refuse(words)
        return low, high

    corner = _list_schema(3, -LARGEST_LENGTH, LARGEST_LENGTH)
    schema = {"type": "array", "items": corner, "minItems": 2, "maxItems": 2}
    return Annotated[tuple[tuple[float, ...], tuple[float, ...]], PlainValidator(check), WithJsonSchema(schema)]


def grid_or(*, low: float, high: float, what: str, builtin: bool) -> Any:
    """A number in [low, high], a file name (or `builtin:` name), or from Python an array [x, y, z]."""
    within = _within(low, high, False, False)
    sources = "a file (.npz, .vdb, .vol)" + (", builtin:plume, builtin:cumulus or builtin:checker" if builtin else "")
    words = f"a number {_range_in_words(low, high, False, False, LARGEST)} ({what}) or {sources}"

    def check(value: Any) -> Any:
        if isinstance(value, str) and value:
            return value
        if getattr(value, "ndim", 0) == 3:
            return value
        value = _plain(value)
        if not _is_number(value) or not within(value):
            raise refuse(words)
        return float(value)

    schema = {"anyOf": [{"type": "number", "minimum": low, "maximum": high}, {"type": "string"}]}
    return Annotated[Any, PlainValidator(check), WithJsonSchema(schema)]


def text(*, what: str) -> Any:
    """A non-empty string."""

    def check(value: Any) -> str:
        if not isinstance(value, str) or not value:
            raise refuse(what)
        return value

    return Annotated[str, PlainValidator(check), WithJsonSchema({"type": "string", "minLength": 1})]


def moments() -> Any:
    """A file of Legendre moments, or from Python the moments themselves."""

    def check(value: Any) -> Any:
        if isinstance(value, str) and value:
            return value
        value = _plain(value)
        if isinstance(value, Sequence) and not isinstance(value, str) and value and all(map(_is_number, value)):
            return tuple(float(x) for x in value)
        raise refuse("a file of Legendre moments (.npz, .json, .txt)")

    return Annotated[Any, PlainValidator(check), WithJsonSchema({"type": "string"})]


def mesh() -> Any:
    """A mesh file or `builtin:` name, or from Python a `trimesh.Trimesh` or a pair (vertices, faces)."""

    def check(value: Any) -> Any:
        if (isinstance(value, str) and value) or isinstance(value, trimesh.Trimesh):
            return value
        if isinstance(value, Sequence) and len(value) == 2 and not isinstance(value, str):
            return np.asarray(value[0]), np.asarray(value[1])
        raise refuse(
            "a mesh file (.ply, .obj, .stl, .glb, .gltf) or builtin:cornell_box, builtin:plane, builtin:sphere or builtin:box"
        )

    return Annotated[Any, PlainValidator(check), WithJsonSchema({"type": "string"})]
