"""Scenes with one moved object: the ground truth for optical flow on a map."""

from dataclasses import replace

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from zerobev.common.errors import InputError
from zerobev.scenes.scene import Scene

_MAX_DISTANCE_M = 1e-3  # between the centres of a face in both meshes


def movable(scene: Scene) -> list[int]:
    """Ids of the instances that stand on the floor, have the size of furniture, and have nothing on top."""
    floor_m = np.median(scene.instance_bounds[[i.id for i in scene.instances if i.name == "floor"], 1, 2])
    found = []
    for instance in scene.instances:
        low, high = scene.instance_bounds[instance.id]
        stands = abs(low[2] - floor_m) < 0.05 and 0.2 < high[2] - low[2] < 1.6
        sized = 0.25 < max(high[:2] - low[:2]) < 1.3
        above = (scene.vertices[:, 2] > high[2] - 0.02) & (scene.vertices[:, 2] < high[2] + 0.1)
        over = above & ((scene.vertices[:, :2] > low[:2]) & (scene.vertices[:, :2] < high[:2])).all(axis=1)
        over[scene.faces[scene.face_instance == instance.id]] = False
        if stands and sized and not over.any():
            found.append(instance.id)
    return found


def moved(scene: Scene, instance: int, shift_m: np.ndarray) -> Scene:
    """The scene with one instance displaced by `shift_m` (3,) metres, world frame.

    Baked light does not change, shadows included. Raises `InputError` unless photograph and annotation have the same
    faces, as in generated homes.
    """
    tree = cKDTree(scene.vertices[scene.faces].mean(axis=1))
    photograph = trimesh.Scene()
    for mesh in scene.photograph.dump():
        distance, face = tree.query(mesh.triangles.mean(axis=1))
        if distance.max() > _MAX_DISTANCE_M:
            raise InputError(f"scene {scene.name}: expected one mesh as photograph and annotation, found two")
        changed = mesh.copy()
        changed.vertices[np.unique(mesh.faces[scene.face_instance[face] == instance])] += shift_m
        photograph.add_geometry(changed)
    vertices = scene.vertices.copy()
    vertices[np.unique(scene.faces[scene.face_instance == instance])] += np.asarray(shift_m, np.float32)
    return replace(scene, vertices=vertices, photograph=photograph)
