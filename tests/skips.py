"""Pairs of scenes with and without what is skipped, small, and what is in the programs that they run."""

import dataclasses

import jax
import jax.numpy as jnp

from jaxvol import media
from jaxvol.benchmark.skips import SKIPS
from jaxvol.methods.deep_screen_space import kernel
from jaxvol.rendering import assign, load_method, method_arguments
from jaxvol.scene import make_scene
from jaxvol.types import Medium

SIZE = {"width": 6, "height": 6}
RAYS = jnp.zeros((4, 3)) - jnp.asarray([2.0, 0.0, 0.0]), jnp.asarray([[1.0, 0.0, 0.0]] * 4), jnp.zeros(4), jnp.full(4, 4.0)


def skip_named(name):
    return next(skip for skip in SKIPS if skip.name == name)


def sides(skip, *, size=SIZE, **larger):
    """Scene files of both sides, small."""
    small = {"resolution": 6, "num_surfels": 64, "num_paths": 8, "samples": 2} | larger
    for config, options in ((skip.present, skip.options), (skip.absent, skip.options | skip.without)):
        options = {key: small.get(key, value) for key, value in options.items()}
        yield make_scene(config | {"camera": config["camera"] | size, "render": skip.render(options)})


def plan_of(skip, file):
    if skip.method == "auto":
        return assign(file, automatic=True)
    module = load_method(skip.method)
    return module.plan(file.scene, file.camera, **method_arguments(module, skip.method, file)[0])


def prepared(skip, **changes):
    """(scene, camera, plan) of both sides, small; without rays that surfaces send, which these skips do not concern."""
    for file in sides(skip, **changes):
        plan = plan_of(skip, file)
        if hasattr(plan, "num_surface_rays"):
            plan = dataclasses.replace(plan, num_surface_rays=0)
        yield file.scene, file.camera, plan


def operations(function, *arguments):
    """Names of the primitives in a function's jaxpr, inner ones too, with how often they occur."""
    found = {}

    def walk(jaxpr):
        for equation in jaxpr.eqns:
            found[equation.primitive.name] = found.get(equation.primitive.name, 0) + 1
            for value in jax.tree.leaves(equation.params, is_leaf=lambda x: hasattr(x, "eqns") or hasattr(x, "jaxpr")):
                if hasattr(value, "eqns"):
                    walk(value)
                elif hasattr(value, "jaxpr"):
                    walk(value.jaxpr)

    walk(jax.make_jaxpr(function)(*arguments).jaxpr)
    return found


def program(stage, args, *, statics):
    """Primitives of a jitted stage at the arguments of a call; `statics` are positions of its static ones."""
    arrays = [x for i, x in enumerate(args) if i not in statics]

    def run(*given):
        rest = iter(given)
        return stage.__wrapped__(*(x if i in statics else next(rest) for i, x in enumerate(args)))

    return operations(run, *arrays)


class Reached(Exception):
    """A stage was called that ends the render."""


def calls_of(monkeypatch, module, name, *, ends=True):
    """What a render hands to a stage: a list of (args, kwargs) that fills up; the stage ends the render, or runs."""
    calls, stage = [], getattr(module, name)

    def record(*args, **kwargs):
        calls.append((args, kwargs))
        if ends:
            raise Reached(name)
        return stage(*args, **kwargs)

    monkeypatch.setattr(module, name, record)
    return calls


def reached(run):
    """Name of the stage at which a render ends; None where it comes to its end."""
    try:
        run()
    except Reached as stage:
        return str(stage)
    return None


def medium_of(density=None, g=0.0):
    return Medium(
        bounds=jnp.asarray([[-1.0] * 3, [1.0] * 3]),
        sigma_s=jnp.asarray([1.0, 0.8, 0.6]),
        sigma_a=jnp.asarray([0.1, 0.1, 0.1]),
        g=jnp.float32(g),
        density=density,
        majorants=None if density is None else media.majorants(density),
    )


def splat_pair(phase, *arguments):
    row = dict(zip(kernel.COLUMNS, (0.3, 0.0, 0.0, -0.6, 0.0, 0.8, 0.0, 1e9, 1e-3, 1.0, 1.0, 1.0), strict=True))
    row = {name: jnp.full((1, 1), value) for name, value in row.items()}
    ray = tuple(jnp.full((1, 1), x) for x in (0.0, 0.0, 1.0))
    return kernel.pair_samples(ray, [jnp.ones((1, 1))], row, phase=phase, g=arguments[0] if arguments else None)[0]
