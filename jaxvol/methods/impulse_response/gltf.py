"""Baked meshes as GLB files that stock viewers open: vertex colours, or a lightmap as emissive texture."""

import numpy as np
import trimesh
from PIL import Image
from trimesh.visual.material import PBRMaterial
from trimesh.visual.texture import TextureVisuals

from jaxvol.methods.impulse_response.lightmap import Lightmap, Vertices


def vertex_colours(mesh: Vertices, srgb: np.ndarray) -> bytes:
    """A GLB with colours [N, 3] in 0..1 (sRGB) at the vertices."""
    colours = np.concatenate([np.clip(srgb, 0, 1), np.ones((len(srgb), 1))], axis=1)
    body = trimesh.Trimesh(
        mesh.position,
        mesh.faces,
        vertex_colors=np.round(colours * 255).astype(np.uint8),
        vertex_normals=mesh.normal,
        process=False,
    )
    return body.export(file_type="glb")


def textured(mesh: Lightmap, srgb: np.ndarray) -> bytes:
    """A GLB whose emissive texture [H, W, 3] in 0..1 (sRGB) is the baked light, so that viewers add none of their own."""
    image = Image.fromarray(np.round(np.clip(srgb, 0, 1) * 255).astype(np.uint8))
    material = PBRMaterial(
        baseColorFactor=[0, 0, 0, 255], metallicFactor=0.0, roughnessFactor=1.0, emissiveTexture=image, emissiveFactor=[1, 1, 1]
    )
    body = trimesh.Trimesh(mesh.position, mesh.faces, visual=TextureVisuals(uv=mesh.uv, material=material), process=False)
    return body.export(file_type="glb")
