"""The configuration of a table set (TOML), validated eagerly; errors name the key, the value and the allowed range."""

import difflib
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

G = Annotated[float, Field(gt=-1, lt=1)]
Albedo = Annotated[float, Field(ge=0, le=1)]
Nodes = Annotated[int, Field(ge=2, le=128)]
Axis = Annotated[int, Field(ge=1, le=64)]


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=False)


def _ordered(values, key: str) -> None:
    if not values[0] <= values[1]:
        raise ValueError(f"{key} = {list(values)} must be [low, high] with low <= high")


class Area(_Table):
    """Resolution of the area emitter's single-scattering table."""

    order: Annotated[int, Field(ge=1, le=11)] = 5
    moments: Annotated[int, Field(ge=1, le=64)] = 8
    num_tau: Nodes = 20
    num_angle: Nodes = 10  # on either side of pi/2


class AreaMultiple(_Table):
    """Resolution of the area emitter's multiple-scattering tables; g, albedo and tau ranges are those of [multiple]."""

    num_tau: Nodes = 18
    num_albedo: Axis = 10
    num_g: Axis = 17
    source_bands: Annotated[int, Field(ge=1, le=24)] = 10  # moments of the patch's emission


class Multiple(_Table):
    """Multiple scattering: the infinite sum over a range of albedo and g, and single bounces at some g."""

    tau: tuple[Annotated[float, Field(ge=1e-4, le=100)], Annotated[float, Field(ge=1e-4, le=100)]] = (1e-3, 30.0)
    num_tau: Nodes = 24
    albedo: tuple[Albedo, Albedo] = (0.0, 1.0)
    num_albedo: Axis = 12
    g: tuple[G, G] = (-0.9, 0.9)
    num_g: Axis = 17
    bounces: Annotated[int, Field(ge=1, le=40)] = 8  # single bounces 2..bounces; 1 = none
    bounce_g: tuple[G, ...] = (0.0,)
    area: AreaMultiple = AreaMultiple()

    @model_validator(mode="after")
    def _check(self):
        _ordered(self.albedo, "albedo")
        _ordered(self.g, "g")
        if not self.tau[0] < self.tau[1]:
            raise ValueError(f"tau = {list(self.tau)} must be [low, high] with low < high")
        for low, high, num, key in ((*self.albedo, self.num_albedo, "albedo"), (*self.g, self.num_g, "g")):
            if (low == high) != (num == 1):
                raise ValueError(f"num_{key} = {num} does not fit {key} = [{low}, {high}]: 1 node exactly where low = high")
        if self.albedo[0] == 1:
            raise ValueError("albedo = [1, 1] is not possible: the infinite sum at albedo 1 needs a range below it")
        if len(set(self.bounce_g)) != len(self.bounce_g):
            raise ValueError(f"bounce_g = {list(self.bounce_g)} names a value twice")
        return self


class Compact(_Table):
    """The compact form: ln(tau e^tau L_l) of a point source, isotropic phase function, Chebyshev in ln tau."""

    tau: tuple[Annotated[float, Field(ge=1e-8, le=600)], Annotated[float, Field(ge=1e-8, le=600)]] = (0.01, 20.0)
    num: Nodes = 16

    @model_validator(mode="after")
    def _check(self):
        if not self.tau[0] < self.tau[1]:
            raise ValueError(f"tau = {list(self.tau)} must be [low, high] with low < high")
        return self


class Texture(_Table):
    """The paper's table, for export as a texture: 256 bins of ln tau, 8 angles, three values of g."""

    num_bins: Annotated[int, Field(ge=2, le=4096)] = 256
    num_angles: Annotated[int, Field(ge=2, le=64)] = 8
    tau: tuple[Annotated[float, Field(ge=1e-4, le=50)], Annotated[float, Field(ge=1e-4, le=50)]] = (0.01, 20.0)
    g_range: Annotated[float, Field(gt=0, lt=1)] = 0.5
    albedo: Annotated[float, Field(ge=0, lt=1)] = 0.9

    @model_validator(mode="after")
    def _check(self):
        if not self.tau[0] < self.tau[1]:
            raise ValueError(f"tau = {list(self.tau)} must be [low, high] with low < high")
        return self


class TableConfig(_Table):
    """A set of tables."""

    emitters: Annotated[tuple[Literal["point", "directional", "area"], ...], Field(min_length=1)] = (
        "point",
        "directional",
        "area",
    )
    order: Annotated[int, Field(ge=1, le=24)] = 11
    moments: Annotated[int, Field(ge=1, le=64)] = 16
    tau_max: Annotated[float, Field(gt=0, le=600)] = 50.0
    num_tau: Nodes = 28
    seed: Annotated[int, Field(ge=0)] = 0  # of the points at which errors are estimated
    area: Area = Area()
    multiple: Multiple | None = None
    compact: Compact = Compact()
    texture: Texture = Texture()


def parse(values: dict[str, Any], *, source: str = "configuration", model: type[BaseModel] = TableConfig) -> Any:
    """Validate a dictionary. Raises ValueError in one line: the source, the key, what is wrong, the nearest known key."""
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise ValueError(f"{source}: {'; '.join(_explain(detail, model) for detail in error.errors()[:3])}") from None


def load(path: str | Path, *, model: type[BaseModel] = TableConfig) -> Any:
    """Read and validate a TOML file. Raises ValueError in one line, OSError for an unreadable file."""
    try:
        with open(path, "rb") as file:
            values = tomllib.load(file)
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: is not valid TOML ({error})") from error
    return parse(values, source=str(path), model=model)


def _explain(detail: dict[str, Any], model: type[BaseModel]) -> str:
    parts = [str(part) for part in detail["loc"]]
    key = ".".join(parts)
    if detail["type"] == "extra_forbidden":
        known = _keys(model, parts[:-1])
        close = difflib.get_close_matches(parts[-1], known, n=1, cutoff=0.5)
        hint = f"did you mean {close[0]}?" if close else f"known keys: {', '.join(known)}"
        return f"unknown key {key}; {hint}"
    message = detail["msg"].removeprefix("Value error, ")
    message = message[0].lower() + message[1:]
    shown = f" = {detail['input']!r}" if isinstance(detail["input"], int | float | str) else ""
    return f"{key}{shown}: {message}" if key else message


def _keys(model: type[BaseModel], path: list[str]) -> list[str]:
    for part in path:
        annotation = model.model_fields[part].annotation
        options = [annotation, *getattr(annotation, "__args__", ())]
        model = next(option for option in options if isinstance(option, type) and issubclass(option, BaseModel))
    return list(model.model_fields)
