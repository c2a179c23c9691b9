"""The tables and keys of a scene file, as pydantic models: names, forms and ranges. No file is opened here.

Unknown keys are refused with the nearest known name, bad values with their range; `explain_error` turns what pydantic
raises into one line.
"""

import difflib
import importlib
import pkgutil
from typing import Annotated, Any, Literal, Union

from pydantic import BaseModel, ConfigDict, Discriminator, Field, Tag, ValidationError, model_validator
from pydantic_core import PydanticCustomError

from jaxvol import scene_values as values
from jaxvol.layers import canonical_sum

MAX_PIXELS_A_SIDE = 16384
MAX_PIXELS = 2**25  # 4096 x 8192; all layers with their variances then take about 7 GB


def method_names() -> tuple[str, ...]:
    """Every method that can render: the folders of `jaxvol.methods`, and `direct`."""
    methods = importlib.import_module("jaxvol.methods")
    return ("direct", *sorted(module.name for module in pkgutil.iter_modules(methods.__path__) if module.ispkg))


def nearest(name: str, known: tuple[str, ...]) -> str:
    """`; did you mean 'x'?`, or the list of all known names when none is near."""
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.6)
    return f"; did you mean {close[0]!r}?" if close else f"; known: {', '.join(known)}"


class Table(BaseModel):
    """A table of a scene file."""

    model_config = ConfigDict(extra="forbid", frozen=True, arbitrary_types_allowed=True)

    @model_validator(mode="before")
    @classmethod
    def _known_keys(cls, data: Any) -> Any:
        if isinstance(data, cls):
            return data
        if not isinstance(data, dict):
            raise PydanticCustomError("table", "must be a table of keys and values")
        known = tuple(cls.model_fields)
        for key in data:
            if key not in known:
                message = "unknown key {key}{hint}"
                raise PydanticCustomError("unknown", message, {"key": repr(key), "hint": nearest(str(key), known)})
        return data


class CameraTable(Table):
    """A pinhole camera; it may stand inside the medium."""

    origin: values.vector()
    target: values.vector()
    up: values.vector(nonzero=True) = (0.0, 1.0, 0.0)
    fov_y: values.number(low=0.01, high=179.0, unit=" degrees") = 40.0  # full vertical angle
    width: values.integer(low=1, high=MAX_PIXELS_A_SIDE) = 512
    height: values.integer(low=1, high=MAX_PIXELS_A_SIDE) = 512

    @model_validator(mode="after")
    def _fits_memory(self) -> "CameraTable":
        pixels = self.width * self.height
        if pixels > MAX_PIXELS:
            message = "width * height = {pixels} must be at most {most}"
            raise PydanticCustomError("value", message, {"pixels": pixels, "most": MAX_PIXELS})
        return self


class TransformTable(Table):
    """Scale, then rotate about an axis through the origin, then translate."""

    scale: values.scale() = (1.0, 1.0, 1.0)
    rotate: values.vector(count=4) = (0.0, 1.0, 0.0, 0.0)  # axis x, y, z, degrees
    translate: values.vector() = (0.0, 0.0, 0.0)

    @model_validator(mode="after")
    def _axis(self) -> "TransformTable":
        if not any(self.rotate[:3]):
            raise PydanticCustomError("value", "rotate = [axis x, y, z, degrees]: the axis must not be zero")
        return self


class ShapeOfMedium(Table):
    """A watertight mesh and where it stands: the long form of a medium's `shape`."""

    mesh: values.mesh()
    transform: TransformTable = Field(default_factory=TransformTable)


def _shape_form(value: Any) -> str:
    return "table" if isinstance(value, dict | ShapeOfMedium) else "mesh"


# A name, or a table of a name and a transform.
Boundary = Annotated[
    Union[Annotated[values.mesh(), Tag("mesh")], Annotated[ShapeOfMedium, Tag("table")]],  # noqa: UP007
    Discriminator(_shape_form),
]


class InclusionTable(Table):
    """A medium bounded by a watertight mesh, inside another medium."""

    density: values.grid_or(low=0.0, high=values.LARGEST, what="homogeneous", builtin=True) = 1.0
    resolution: values.integer(low=1, high=1024) | None = None  # of a builtin density
    seed: values.integer(low=0, high=2**32 - 1) | None = None  # of a builtin density
    bounds: values.box() | None = None
    scattering: values.rgb() = (1.0, 1.0, 1.0)  # per unit length at density 1
    absorption: values.rgb() = (0.0, 0.0, 0.0)  # per unit length at density 1
    anisotropy: values.number(low=-1, high=1, open_low=True, open_high=True) | None = None
    phase: values.moments() | None = None
    refractive_index: values.grid_or(low=0.1, high=10.0, what="constant", builtin=False) | None = None
    shape: Boundary

    @model_validator(mode="after")
    def _together(self) -> "InclusionTable":
        if self.anisotropy is not None and self.phase is not None:
            raise PydanticCustomError("value", "anisotropy and phase exclude each other")
        builtin = isinstance(self.density, str) and self.density.startswith("builtin:")
        for key in ("resolution", "seed"):
            if getattr(self, key) is not None and not builtin:
                message = "{key} belongs to a builtin density only"
                raise PydanticCustomError("value", message, {"key": key})
        return self


class MediumTable(InclusionTable):
    """The participating medium. Where inclusions overlap it or each other, the last one that contains a point wins."""

    shape: Boundary | None = None
    inclusions: tuple[InclusionTable, ...] = ()

    @model_validator(mode="after")
    def _has_an_extent(self) -> "MediumTable":
        if isinstance(self.density, float) and self.bounds is None and self.shape is None:
            raise PydanticCustomError("value", "bounds is missing: a homogeneous medium needs bounds or a shape")
        return self


class ShapeTable(Table):
    """A mesh with one material; colours of the mesh file hold unless `reflectance` or `emission` is given."""

    mesh: values.mesh()
    reflectance: values.rgb(high=1.0) | None = None
    emission: values.rgb() | None = None  # radiance, from the front side
    specular: values.rgb(high=1.0) | None = None  # energy of the normalised Phong lobe
    exponent: values.number(low=0.0, high=1e5) = 20.0
    transform: TransformTable = Field(default_factory=TransformTable)
    flip_normals: bool = False  # fronts become backs: for meshes that are wound inward


class PointTable(Table):
    """A point light."""

    kind: Literal["point"]
    position: values.vector()
    intensity: values.rgb()


class SpotTable(Table):
    """A spot light: full inside `falloff`, zero outside `angle`, linear in the angle in between (half-angles, degrees)."""

    kind: Literal["spot"]
    position: values.vector()
    direction: values.vector(nonzero=True)
    intensity: values.rgb()
    angle: values.number(low=0.0, high=180.0, open_low=True, unit=" degrees")
    falloff: values.number(low=0.0, high=180.0, unit=" degrees") | None = None  # default: 0.75 angle

    @model_validator(mode="after")
    def _falloff_inside(self) -> "SpotTable":
        if self.falloff is not None and self.falloff > self.angle:
            message = "falloff = {falloff} must be a number in [0, angle = {angle}] degrees"
            raise PydanticCustomError("value", message, {"falloff": self.falloff, "angle": self.angle})
        return self


class DirectionalTable(Table):
    """Light from infinitely far: `direction` of travel, `irradiance` on a plane facing it."""

    kind: Literal["directional"]
    direction: values.vector(nonzero=True)
    irradiance: values.rgb()


class EnvironmentTable(Table):
    """Light from everywhere: a latitude-longitude map (y up) or one radiance."""

    kind: Literal["environment"]
    file: values.text(what="the name of an EXR file (latitude-longitude, y up)") | None = None
    radiance: values.rgb() | None = None
    rotation: values.number(low=-1e6, high=1e6, unit=" degrees") = 0.0  # about y
    scale: values.rgb() = (1.0, 1.0, 1.0)

    @model_validator(mode="after")
    def _one_source(self) -> "EnvironmentTable":
        if (self.file is None) == (self.radiance is None):
            raise PydanticCustomError("value", "needs either file or radiance")
        return self


LightTable = Annotated[PointTable | SpotTable | DirectionalTable | EnvironmentTable, Field(discriminator="kind")]
LIGHT_KINDS = ("point", "spot", "directional", "environment")


class RenderTable(Table):
    """How to render: what the command's options override, and a table of keyword arguments for each method."""

    method: values.text(what="the name of a method") = "path_tracing"
    samples: values.integer(low=1, high=2**31 - 1) = 64  # per pixel
    seed: values.integer(low=0, high=2**32 - 1) = 0
    max_scatterings: values.integer(low=1, high=2**20) | None = None  # None: as many as there are
    russian_roulette: bool = True
    exposure: values.number(low=-100, high=100, unit=" stops") | Literal["auto"] = "auto"
    layers: dict[str, str] | None = None  # which method computes which layer (or sum of layers) of a composite
    allow_partial: bool = False  # whether a composite may use a method that misses some paths of a layer
    negligible: values.number(low=0, high=1) = 1e-4  # share of the scattered light that "auto" may leave out; 0: none
    options: dict[str, dict[str, Any]] = {}  # filled from [render.<method>]

    @model_validator(mode="before")
    @classmethod
    def _known_keys(cls, data: Any) -> Any:
        if isinstance(data, cls):
            return data
        if not isinstance(data, dict):
            raise PydanticCustomError("table", "must be a table of keys and values")
        methods = method_names()
        known = tuple(name for name in cls.model_fields if name != "options")
        plain, options = {}, dict(data.get("options", {}))
        for key, value in data.items():
            if key in methods:
                if not isinstance(value, dict):
                    message = "{key} must be a table: the keyword arguments of that method"
                    raise PydanticCustomError("table", message, {"key": key})
                options[key] = value
            elif key in known:
                plain[key] = value
            elif key != "options":
                hint = nearest(str(key), known + methods)
                raise PydanticCustomError("unknown", "unknown key {key}{hint}", {"key": repr(key), "hint": hint})
        return plain | {"options": options}

    @model_validator(mode="after")
    def _known_methods(self) -> "RenderTable":
        known = (*method_names(), "auto")
        named = [self.method] if "method" in self.model_fields_set else []
        for name in (*named, *(self.layers or {}).values()):
            if name not in known:
                hint = nearest(name, known)
                raise PydanticCustomError("value", "unknown method {name}{hint}", {"name": repr(name), "hint": hint})
        for name in self.layers or {}:
            try:
                canonical_sum(name)
            except ValueError as error:
                raise PydanticCustomError("value", "layers: {error}", {"error": str(error)}) from error
        return self


class SceneTable(Table):
    """A whole scene file."""

    camera: CameraTable | None = None
    medium: MediumTable | None = None
    shapes: tuple[ShapeTable, ...] = ()
    lights: tuple[LightTable, ...] = ()
    render: RenderTable = Field(default_factory=RenderTable)

    @model_validator(mode="after")
    def _one_sky(self) -> "SceneTable":
        skies = [index for index, light in enumerate(self.lights) if light.kind == "environment"]
        if len(skies) > 1:
            message = "lights.{index}: a scene has at most one environment light"
            raise PydanticCustomError("value", message, {"index": skies[1]})
        return self


def json_schema() -> dict[str, Any]:
    """The JSON schema of a scene file, for editors and for programs that write scenes."""
    schema = SceneTable.model_json_schema()
    schema["title"] = "jaxvol scene"
    render = schema["$defs"]["RenderTable"]["properties"]
    del render["options"]
    for name in method_names():
        render[name] = {"type": "object", "description": f"keyword arguments of the method {name}"}
    return schema


def explain_error(error: ValidationError) -> str:
    """One line: key, value, what is allowed; says how many more keys are wrong."""
    errors = error.errors(include_url=False)
    more = len({_key(e["loc"]) for e in errors}) - 1
    return _explain(errors[0]) + (f" (and {more} more)" if more > 0 else "")


def _key(location: tuple[str | int, ...]) -> str:
    """The dotted key without the tags by which pydantic names the members of a union."""
    path = []
    for index, part in enumerate(location):
        before = location[index - 1] if index else None
        is_kind = part in LIGHT_KINDS and isinstance(before, int)
        is_form = part in ("mesh", "table") and before == "shape"
        if not is_kind and not is_form and not str(part).startswith(("function-", "literal[")):
            path.append(str(part))
    return ".".join(path) or "the scene"


def _explain(error: dict[str, Any]) -> str:
    key, kind, message = _key(error["loc"]), error["type"], error["msg"]
    shown = " ".join(repr(error["input"]).split())
    shown = shown if len(shown) <= 60 else shown[:57] + "..."
    match kind:
        case "missing":
            return f"{key} is missing"
        case "union_tag_not_found":
            return f"{key}.kind is missing; must be one of {', '.join(LIGHT_KINDS)}"
        case "union_tag_invalid":
            tag = str(error["ctx"]["tag"])
            return f"{key}.kind = {tag!r} must be one of {', '.join(LIGHT_KINDS)}{nearest(tag, LIGHT_KINDS)}"
        case "tuple_type" | "list_type":
            return f"{key} = {shown} must be a list of tables ([[{key}]])"
        case "dict_type" | "model_attributes_type":
            return f"{key} = {shown} must be a table of keys and values"
        case "bool_parsing" | "bool_type":
            return f"{key} = {shown} must be true or false"
        case "value" if message.startswith("must be"):
            return f"{key} = {shown} {message}"
    return f"{key}: {message}"
