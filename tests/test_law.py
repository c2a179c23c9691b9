"""The house rules (ARCHITECTURE sections 1 and 5), read off the source. Each rule returns the places that break it."""

import ast
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "jaxvol"
SOURCES = sorted(PACKAGE.rglob("*.py"))
MAX_LINES = 400


def name_of(path: Path) -> str:
    """`jaxvol.methods.direct` for jaxvol/methods/direct/__init__.py."""
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def rank(module: str) -> int:
    """How high a module stands; imports may only go to the same height or down."""
    parts = module.split(".")[1:]
    if not parts:
        return 0
    top = parts[0]
    if top in ("types", "layers"):
        return ("types", "layers").index(top)
    if top in ("methods", "fit"):
        return 3
    if top in ("scene", "scene_config", "meshes"):
        return 4
    return {"commands": 6, "cli": 7, "__main__": 7}.get(top, 5 if top in HIGH else 2)


# Modules that serve the commands alone: they may know scenes and methods, and no method may know them.
HIGH = ("composite", "benchmark", "peer", "stress", "method_registry", "rendering")


def imports(tree: ast.AST, module: str) -> Iterator[tuple[int, str]]:
    known = {name_of(path) for path in SOURCES}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield node.lineno, alias.name
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}:{node.lineno}: relative import; write the full name"
            for alias in node.names:
                whole = f"{node.module}.{alias.name}"
                yield node.lineno, whole if whole in known else node.module


def call_name(node: ast.Call) -> str:
    return ast.unparse(node.func)


def is_blind(handler: ast.ExceptHandler) -> bool:
    kinds = handler.type.elts if isinstance(handler.type, ast.Tuple) else [handler.type]
    return any(kind is None or ast.unparse(kind) in ("Exception", "BaseException") for kind in kinds)


def imports_upwards(path: Path, tree: ast.AST) -> Iterator[str]:
    module = name_of(path)
    family = module.split(".")[1:3]
    for line, target in imports(tree, module):
        if not target.startswith("jaxvol"):
            continue
        if rank(target) > rank(module):
            yield f"{line}: {module} imports {target}, which stands above it"
        other = target.split(".")[1:3]
        if family[:1] == other[:1] == ["methods"] and len(other) == 2 and family != other:
            yield f"{line}: method {module} imports method {target}; shared physics belongs into a physics module"


def too_long(path: Path, tree: ast.AST) -> Iterator[str]:
    count = len(path.read_text().splitlines())
    if count > MAX_LINES:
        yield f"{count} lines; at most {MAX_LINES}"


def sets_jax_options(path: Path, tree: ast.AST) -> Iterator[str]:
    if path == PACKAGE / "cli.py":
        return
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and call_name(node).endswith("config.update"):
            yield f"{node.lineno}: only cli.py and tests/conftest.py set JAX options"


def catches_everything(path: Path, tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.ExceptHandler) and is_blind(node):
            yield f"{node.lineno}: name the exceptions that you expect"


def fractional_powers(path: Path, tree: ast.AST) -> Iterator[str]:
    if "fit" in path.relative_to(PACKAGE).parts:
        return
    for node in ast.walk(tree):
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Pow):
            if ".shape" in ast.unparse(node.left) or not any(isinstance(n, ast.Name) for n in ast.walk(node.left)):
                continue  # known when tracing: no kernel computes it
            sign = node.right.operand if isinstance(node.right, ast.UnaryOp) else node.right
            if isinstance(sign, ast.Constant) and float(sign.value) != int(sign.value):
                yield f"{node.lineno}: `{ast.unparse(node)}` is a slow pow; write it with sqrt"


def pickles(path: Path, tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.keyword) and node.arg == "allow_pickle" and ast.unparse(node.value) != "False":
            yield f"{node.value.lineno}: a file from elsewhere must not run code"
        if isinstance(node, ast.Import | ast.ImportFrom) and "pickle" in ast.unparse(node):
            yield f"{node.lineno}: no pickle"


def forbidden_jax(path: Path, tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        name = ast.unparse(node) if isinstance(node, ast.Attribute) else ""
        if name.endswith((".filter_jit", ".pure_callback", ".io_callback")):
            yield f"{node.lineno}: {name} (retraces, or keeps programs out of the compilation cache)"
        if isinstance(node, ast.Call) and call_name(node) in ("jax.jit", "jit"):
            if node.args and isinstance(node.args[0], ast.Lambda):
                yield f"{node.lineno}: jit of a lambda compiles again at every call"


def writes_in_place(path: Path, tree: ast.AST) -> Iterator[str]:
    """Files appear whole or not at all: whoever writes one does so through jobs.atomic_write."""
    text = path.read_text()
    if path.name == "jobs.py" or "atomic" in text:
        return
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call):
            continue
        name = call_name(node)
        mode = node.args[1] if len(node.args) > 1 else None
        opens = name == "open" and isinstance(mode, ast.Constant) and str(mode.value)[0] in "wax"
        writers = (".write_text", ".write_bytes", "np.savez", "np.savez_compressed", "np.save", ".savefig")
        if opens or (name.endswith(writers) and not name.startswith("jobs.")):
            yield f"{node.lineno}: {name} without jobs.atomic_write"


def public_functions(tree: ast.Module) -> Iterator[ast.FunctionDef]:
    for node in tree.body:
        if isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
            yield node


def undocumented(path: Path, tree: ast.AST) -> Iterator[str]:
    if not ast.get_docstring(tree):
        yield "1: module without a docstring"
    for function in public_functions(tree):
        if not ast.get_docstring(function):
            yield f"{function.lineno}: {function.name} has no docstring"


COUNTERS = {"uniforms"}  # the coordinates of a counter are data, the last of them rarely used


def positional_options(path: Path, tree: ast.AST) -> Iterator[str]:
    if "commands" in path.parts:  # typer reads options from the signature
        return
    for function in public_functions(tree):
        if function.args.defaults and function.name not in COUNTERS:
            yield f"{function.lineno}: {function.name}: options (arguments with a default) must be keyword-only"


# Uniform barycentrics and indices into a table, whose density the caller knows; particles that carry power / pdf.
WITHOUT_PDF = {"sample_triangle", "sample_cdf", "sample_emission"}


def samplers_without_pdf(path: Path, tree: ast.AST) -> Iterator[str]:
    if path.parent != PACKAGE:
        return
    names = {function.name for function in public_functions(tree)}
    for name in sorted(names - WITHOUT_PDF):
        if re.match("sample(_|$)", name) and not name.endswith("_pdf") and f"{name}_pdf" not in names:
            yield f"1: {name} has no {name}_pdf beside it"


RULES = (
    samplers_without_pdf,
    imports_upwards,
    too_long,
    sets_jax_options,
    catches_everything,
    fractional_powers,
    pickles,
    forbidden_jax,
    writes_in_place,
    undocumented,
    positional_options,
)


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.__name__)
def test_law(rule):
    broken = [
        f"{path.relative_to(PACKAGE.parent)}:{complaint}"
        for path in SOURCES
        for complaint in rule(path, ast.parse(path.read_text()))
    ]
    assert not broken, "\n" + "\n".join(broken)


@pytest.mark.parametrize(
    ("rule", "source", "place"),
    [
        (imports_upwards, "from jaxvol.methods import path_tracing\n", "camera.py"),
        (imports_upwards, "from jaxvol.scene import load_scene\n", "methods/path_tracing/__init__.py"),
        (imports_upwards, "import jaxvol.methods.path_tracing\n", "methods/deep_screen_space/surfels.py"),
        (sets_jax_options, "jax.config.update('jax_enable_x64', True)\n", "media.py"),
        (catches_everything, "try:\n    f()\nexcept (ValueError, Exception):\n    pass\n", "media.py"),
        (catches_everything, "try:\n    f()\nexcept:\n    pass\n", "media.py"),
        (fractional_powers, "y = x ** -1.5\n", "media.py"),
        (pickles, "np.load(f, allow_pickle=True)\n", "volumes.py"),
        (forbidden_jax, "f = eqx.filter_jit(g)\n", "media.py"),
        (forbidden_jax, "f = jax.jit(lambda x: x)\n", "media.py"),
        (writes_in_place, "open(path, 'wb')\n", "media.py"),
        (writes_in_place, "path.write_text('a')\n", "media.py"),
        (samplers_without_pdf, "def sample_cone(u):\n    return u\n", "sampling.py"),
        (undocumented, "'''Doc.'''\ndef f(x):\n    return x\n", "media.py"),
        (positional_options, "def f(x, size=3):\n    return x\n", "media.py"),
    ],
)
def test_the_rules_find_what_they_forbid(rule, source, place):
    path = PACKAGE / place
    if rule is writes_in_place:  # this rule reads the file itself
        complaints = [c for c in _writes_of(source)]
    else:
        complaints = list(rule(path, ast.parse(source)))
    assert complaints


def _writes_of(source: str) -> list[str]:
    class Source(type(PACKAGE)):
        def read_text(self):
            return source

    return list(writes_in_place(Source("other.py"), ast.parse(source)))


def test_excluded_jaxlib_releases():
    project = tomllib.loads((PACKAGE.parent / "pyproject.toml").read_text())["project"]
    for package in ("jax", "jaxlib"):
        (line,) = [d for d in project["dependencies"] if re.match(rf"{package}[>=!]", d)]
        for release in ("0.10.2", "0.11.0", "0.11.1"):
            assert f"!={release}" in line, f"{line} admits {release}"


def test_constraints_hold_names_and_versions_only():
    for line in (PACKAGE.parent / "constraints.txt").read_text().splitlines():
        assert re.fullmatch(r"[A-Za-z0-9_.\-]+==[A-Za-z0-9.]+", line), line
