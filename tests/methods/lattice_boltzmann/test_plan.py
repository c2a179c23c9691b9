"""What the method claims, plans, refuses and skips."""

import jax.numpy as jnp
import pytest

from jaxvol.methods import lattice_boltzmann
from jaxvol.types import Scene
from tests.methods.lattice_boltzmann.builders import SMALL, box_scene


def test_an_index_of_one_is_no_index():
    plan = lattice_boltzmann.plan(box_scene(ior=jnp.float32(1.00005)), None, **SMALL)
    assert not plan.refract and plan.margin == 0 and any("straight rays" in reason for reason in plan.skipped)
    assert lattice_boltzmann.plan(box_scene(ior=jnp.float32(1.01)), None, **SMALL).refract


def test_anisotropic_media_claim_only_the_sum():
    claim, _ = lattice_boltzmann.claims(box_scene(g=jnp.float32(0.5)))
    assert claim.layers == ("volume_from_light", "volume_from_volume", "volume_from_multiple") and "anisotropy" in claim.partial


def test_nothing_scatters_no_lattice():
    plan = lattice_boltzmann.plan(box_scene(sigma_s=(0.0, 0.0, 0.0)), None, **SMALL)
    assert not plan.solve and any("nothing scatters" in reason for reason in plan.skipped)


def test_coarse_lattice_is_warned_with_the_resolution_that_would_do():
    plan = lattice_boltzmann.plan(box_scene(sigma_s=(40.0, 40.0, 40.0)), None, **SMALL)
    (warning,) = [reason for reason in plan.skipped if reason.startswith("warning")]
    assert "resolution = 41" in warning and plan.probability_map == "exp"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"lattice": "19"}, "lattice = '19' must be one of paper, 18, 26"),
        ({"filter_width": 0.3}, "filter_width = 0.3 must be within"),
        ({"march_step": 1.5}, "march_step = 1.5 must be within"),
        ({"probability_map": "linear"}, "probability_map"),
        ({"boundary_reflectance": 1.2}, "must be within"),
    ],
)
def test_bad_options(options, message):
    with pytest.raises(ValueError, match=message):
        lattice_boltzmann.plan(box_scene(), None, **(SMALL | options))


def test_closed_white_box_is_refused_with_the_reason():
    scene = box_scene(sigma_a=(0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="no steady state"):
        lattice_boltzmann.plan(scene, None, **SMALL, boundary_reflectance=1.0)
    assert lattice_boltzmann.plan(scene, None, **SMALL).solve  # an open one of albedo 1 works


def test_missing_medium():
    assert lattice_boltzmann.claims(Scene()) == ()
    with pytest.raises(ValueError, match="medium is missing"):
        lattice_boltzmann.plan(Scene(), None)
