"""Every line of the specification's lists of the paper's errors, pitfalls, tests and savings, and the test that holds it.

Two savings are not built: equal p_a over channels share a solve only where the lights are of one colour too (then there is
one channel anyway), and a solve of an unchanged volume does not start from the last one.
"""

import ast
from pathlib import Path

import pytest

ERRORS_OF_THE_PAPER = {
    "Fig. 4 mixes two forms of the eikonal and does not converge": ("test_the_papers_listing_does_not_converge",),
    "od *= exp(-..), and what is deposited is the power removed": ("test_straight_rays_conserve_and_follow_beer",),
    "the march ends: live rays only, none left over": (
        "test_dead_rays_cost_nothing",
        "test_straight_rays_conserve_and_follow_beer",
    ),
    "Theta as printed absorbs nothing: albedo 1": ("test_paper_theta_absorbs_nothing_and_is_albedo_one",),
    "Geist's weights are of degree 3 only": ("test_geist_weights_conserve_and_are_only_degree_three",),
    "sigma is no probability per step": ("test_linear_map_halves_the_diffusion_constant",),
    "six directions: ray effects and a wrong vacuum boundary": (
        "test_quadrature_degree",
        "test_decay_constant_against_exact_transport",
    ),
    "radiance scales with n^2": ("test_refraction_radiance_over_all_exits_and_absorption_make_the_input",),
    "emission from fluence, not from collisions": (
        "test_emission_density_of_a_slab_against_the_integral_equation",
        "test_slab_reflectance_and_transmittance",
    ),
}
PITFALLS = {
    "p = sigma h diverges above 2: refused": ("test_linear_map_diverges_where_pade_does_not", "test_bad_options"),
    "a closed box of albedo 1 has no steady state: refused": ("test_closed_white_box_is_refused_with_the_reason",),
    "an unfiltered jump of n drifts in |p| / n": ("test_a_jump_of_the_index_drifts_without_the_filter",),
    "filter below 0.75 voxels or step above h: refused": ("test_bad_options",),
    "grazing and total reflection: no negative radicand": ("test_grazing_rays_keep_their_energy", "test_total_reflection"),
    "voxels without extinction: F from T b": ("test_every_way_to_the_fixed_point_agrees_and_conserves",),
    "marching too few steps: live power below 1e-4": (
        "test_layers_are_claimed_and_books_balance",
        "test_straight_rays_conserve_and_follow_beer",
        "test_bent_rays_conserve_and_reach_the_same_books_without_bending",
    ),
    "the 1/n^2 law and internal reflection belong together": (
        "test_refraction_radiance_over_all_exits_and_absorption_make_the_input",
    ),
}
TESTS = {
    "columns of Theta sum to 1 - p_a": (
        "test_theta_columns_lose_only_what_is_absorbed",
        "test_theta_of_equal_links_is_the_published_pade_form",
    ),
    "the paper's Theta is albedo 1": ("test_paper_theta_absorbs_nothing_and_is_albedo_one",),
    "D = (h/3)(1/p - 1/2) to 1e-5": ("test_diffusion_constant_of_six_directions_is_exact",),
    "kappa against exact transport, below 0.5 %": ("test_decay_constant_against_exact_transport",),
    "absorbed + escaped = source to 1e-5": ("test_every_way_to_the_fixed_point_agrees_and_conserves",),
    "impulse = steady to 1e-5": ("test_one_impulse_added_up_is_the_steady_source",),
    "blocks and the whole lattice have one fixed point": ("test_blocks_have_the_same_fixed_point",),
    "sweeps and lattice steps have one fixed point": ("test_every_way_to_the_fixed_point_agrees_and_conserves",),
    "interleaved marching changes nothing": ("test_marching_and_diffusing_in_turn_changes_nothing",),
    "T is symmetric": ("test_transport_is_symmetric",),
    "Luneburg and fish-eye below 1e-3 at 0.05": ("test_luneburg_lens_focuses", "test_fish_eye_images_every_point_opposite"),
    "Snell below 0.02 degrees at a step of the filter's width": ("test_snell_at_a_step_as_wide_as_the_filter",),
    "total reflection": ("test_total_reflection",),
    "total of the deposit": ("test_straight_rays_conserve_and_follow_beer",),
    "volume of voxels to 1e-4": ("test_volume_of_real_meshes", "test_volume_of_a_sphere"),
    "a cube against Monte Carlo, 8 and 3 %": ("test_fluence_in_a_cube_against_monte_carlo",),
    "gradient against finite differences, 1 %": ("test_gradient_of_the_solve_against_finite_differences",),
    "symmetry under the cube's group": ("test_cube_symmetry",),
}
SAVINGS = {
    "|n - 1| below 1e-4: straight rays": ("test_an_index_of_one_is_no_index",),
    "homogeneous: numbers for coefficients, few applications": (
        "test_homogeneous_boxes_solve_with_numbers",
        "test_few_applications_at_high_albedo",
    ),
    "albedo below 0.05: about one sweep": ("test_dark_media_need_few_applications",),
    "sigma_s = 0: no lattice": ("test_nothing_scatters_no_lattice",),
    "crop to what is filled": ("test_empty_border_of_a_grid_costs_nothing",),
    "empty blocks inside: rays jump over them": (
        "test_light_leaves_the_same_track_in_fewer_steps",
        "test_no_filled_voxel_lies_outside_the_span",
        "test_the_picture_is_the_same",
    ),
    "dead rays are dropped": ("test_dead_rays_cost_nothing",),
    "grey: one channel": ("test_three_equal_channels_are_one",),
}
LINES = ERRORS_OF_THE_PAPER | PITFALLS | TESTS | SAVINGS


@pytest.fixture(scope="module")
def known():
    here = Path(__file__).parent
    files = [*here.glob("test_*.py"), here.parents[1] / "test_voxelization.py"]
    trees = [ast.parse(path.read_text()) for path in files]
    return {node.name for tree in trees for node in tree.body if isinstance(node, ast.FunctionDef)}


@pytest.mark.parametrize("line", LINES)
def test_the_line_has_its_test(line, known):
    assert LINES[line] and set(LINES[line]) <= known
