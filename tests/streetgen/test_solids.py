"""Simple bodies are closed where they say so, look outwards, and have textures of a true size."""

from collections import Counter

import numpy as np
import pytest

from streetgen.classes import Label
from streetgen.geometry.mesh import Mesh, faceted
from streetgen.geometry.solids import Surface, boxes, disc, quads, tube

CLAY = Surface("clay", Label.OBJECT, tile_m=2.0)


def edges(mesh: Mesh) -> Counter[tuple[tuple[float, ...], tuple[float, ...]]]:
    """Directed edges by the places of their ends."""
    places = [tuple(np.round(vertex, 5).tolist()) for vertex in mesh.vertices]
    return Counter(
        (places[face[i]], places[face[(i + 1) % 3]]) for face in mesh.faces for i in range(3)
    )


def volume_m3(mesh: Mesh) -> float:
    """Return the volume by the divergence theorem; positive where faces turn anticlockwise."""
    a, b, c = mesh.vertices[mesh.faces].astype(float).transpose(1, 0, 2)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def test_boxes_are_closed_and_hold_their_volume():
    mesh = boxes(CLAY, [(0, 0, 0), (5, 5, 5)], [(1, 2, 3), (6, 6, 7)])
    directed = edges(mesh)
    assert all(directed[end, start] == count for (start, end), count in directed.items())
    assert volume_m3(mesh) == pytest.approx(6 + 2, rel=1e-6)


def test_a_boxs_texture_has_its_size():
    """Every edge of a 2 by 4 by 6 m box is as long in texture tiles of 2 m as it says."""
    mesh = boxes(CLAY, (0, 0, 0), (2, 4, 6))
    for start, end in ((0, 1), (1, 2)):
        corners = mesh.faces[:, [start, end]]
        length_m = np.linalg.norm(np.diff(mesh.vertices[corners], axis=1), axis=2)
        tiles = np.linalg.norm(np.diff(mesh.uv[corners], axis=1), axis=2)
        np.testing.assert_allclose(tiles, length_m / 2.0, rtol=1e-6)


def test_a_tube_is_as_thick_as_its_radius_and_looks_outwards():
    bend = np.linspace(0, np.pi / 2, 9)
    path = np.stack([5 * np.cos(bend), 0 * bend, 5 * np.sin(bend)], axis=1)
    mesh = tube(CLAY, path, 0.25, 12)
    off = np.linalg.norm(mesh.vertices.reshape(9, 13, 3) - path[:, None], axis=2)
    np.testing.assert_allclose(off, 0.25, rtol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, rtol=1e-5)
    flat = faceted(Mesh(mesh.vertices, mesh.faces, mesh.uv, "clay", Label.OBJECT))
    smooth = mesh.normals[mesh.faces].mean(axis=1)
    assert (np.einsum("ij,ij->i", smooth, flat.normals[::3]) > 0.5).all()


def test_a_disc_faces_where_it_is_told_with_its_picture_upright():
    mesh = faceted(disc(CLAY, (1, 2, 3), (0, -1, 0), 0.5, 64))
    assert mesh.normals is not None
    np.testing.assert_allclose(mesh.normals, np.tile([0, -1, 0], (len(mesh.normals), 1)), atol=1e-6)
    right, up = mesh.vertices[:, 0] - 1, mesh.vertices[:, 2] - 3
    np.testing.assert_allclose(mesh.uv[:, 0] - 0.5, right, atol=1e-6)
    np.testing.assert_allclose(0.5 - mesh.uv[:, 1], up, atol=1e-6)


def test_a_rectangle_shows_its_texture_upright():
    """Seen from -y, x is to the right and z up; row 0 of a texture is its upper edge."""
    mesh = quads(CLAY, [(0, 0, 0), (1, 0, 0), (1, 0, 1), (0, 0, 1)])
    np.testing.assert_array_equal(
        mesh.uv, np.stack([mesh.vertices[:, 0], 1 - mesh.vertices[:, 2]], 1)
    )
    assert volume_m3(faceted(mesh)) == 0
