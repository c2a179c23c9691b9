"""The tables and keys of a benchmark file, as pydantic models."""

import tomllib
from pathlib import Path
from typing import Any

from pydantic import Field, ValidationError, model_validator
from pydantic_core import PydanticCustomError

from jaxvol.scene_config import Table, explain_error, method_names, nearest

Settings = dict[str, Any]  # keyword arguments of a method, or dotted keys below [render]


class SceneEntry(Table):
    """A scene and how it is rendered here."""

    file: str  # relative to the benchmark file
    name: str | None = None
    width: int = Field(64, ge=1)
    height: int = Field(48, ge=1)
    overrides: tuple[str, ...] = ()
    methods: tuple[str, ...] | None = None  # default: all
    peer: bool = True  # also with Mitsuba
    peer_scale: float = Field(1.0, gt=0)  # of the exported scene; Mitsuba's ray offsets want sizes of 10 and more
    peer_integrator: str = "volpath"


class MethodEntry(Table):
    """A method of ours by name, "auto", or anyone's function by `entry`."""

    name: str
    method: str | None = None  # default: its name
    entry: str | None = None  # "module:function" or the name of an entry point of the group "jaxvol.methods"
    settings: tuple[Settings, ...] = ({},)  # one run each; the first counts as the default
    curves: tuple[str, ...] | None = None  # scenes in which all settings are run, elsewhere the first only; default: all
    rays_per_pixel: int = Field(4, ge=1)  # that an `entry` gets

    @model_validator(mode="after")
    def _known(self) -> "MethodEntry":
        known = (*method_names(), "auto")
        if self.entry is None and (self.method or self.name) not in known:
            hint = nearest(self.method or self.name, known)
            raise PydanticCustomError("value", "unknown method {name}{hint}", {"name": repr(self.name), "hint": hint})
        if not self.settings:
            raise PydanticCustomError("value", "settings must hold one table at least")
        return self


class ScalingEntry(Table):
    """How run time grows: `overrides` with {n} replaced by each of `values`; the count of things is n ** power."""

    name: str
    scene: str
    method: str  # a method of ours, or "bake" (a lightmap of n x n texels)
    overrides: tuple[str, ...] = ()
    values: tuple[int, ...] = Field(min_length=2)
    power: int = Field(1, ge=1, le=3)


class ReferenceTable(Table):
    """When a reference is good enough, whichever comes first."""

    seconds: float = Field(10.0, gt=0)
    until_error: float | None = Field(None, gt=0, lt=1)  # mean standard error of 8 x 8 blocks over the mean


class PeerTable(Table):
    """Mitsuba 3 with `volpath`, where it is installed."""

    enabled: bool = True
    samples: tuple[int, ...] = (4, 16, 64)
    batches: int = Field(4, ge=2)  # their spread is Mitsuba's variance


class BenchmarkTable(Table):
    """A whole benchmark file."""

    scenes: tuple[SceneEntry, ...] = Field(min_length=1)
    methods: tuple[MethodEntry, ...] = Field(min_length=1)
    scaling: tuple[ScalingEntry, ...] = ()
    reference: ReferenceTable = Field(default_factory=ReferenceTable)
    mitsuba: PeerTable = Field(default_factory=PeerTable)
    processes: int = Field(1, ge=1, le=64)  # that make first calls, all at a time; what is timed runs alone
    repeats: int = Field(3, ge=1)  # warm runs, of which the median counts
    block: int = Field(4, ge=1)  # pixels a side, over which relative L1 and p99 are averaged
    seed: int = Field(1, ge=0)

    @model_validator(mode="after")
    def _names(self) -> "BenchmarkTable":
        known = tuple(method.name for method in self.methods)
        if len(set(known)) < len(known):
            raise PydanticCustomError("value", "methods: two have one name")
        names = tuple(scene_name(scene) for scene in self.scenes)
        for method in self.methods:
            for name in set(method.curves or ()) - set(names):
                hint = nearest(name, names)
                raise PydanticCustomError("value", "methods: curves: no scene {name}{hint}", {"name": repr(name), "hint": hint})
        for scene in self.scenes:
            for name in scene.methods or ():
                if name not in known:
                    hint = nearest(name, known)
                    raise PydanticCustomError(
                        "value", "scenes: unknown method {name}{hint}", {"name": repr(name), "hint": hint}
                    )
        return self


def scene_name(entry: SceneEntry) -> str:
    """What results are filed under."""
    return entry.name or Path(entry.file).stem


def load_config(path: str | Path) -> BenchmarkTable:
    """Read a benchmark file. Raises ValueError, in one line, for whatever is wrong."""
    path = Path(path)
    try:
        table = tomllib.loads(path.read_text())
    except OSError as error:
        raise ValueError(f"benchmark file {path} cannot be read: {error.strerror or error}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is no TOML file: {error}") from error
    try:
        return BenchmarkTable.model_validate(table)
    except ValidationError as error:
        raise ValueError(f"{path}: {explain_error(error)}") from error
