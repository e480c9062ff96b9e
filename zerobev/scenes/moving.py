"""Homes in which one object has moved: what optical flow on a map can be held against."""

from dataclasses import replace

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from zerobev.common.errors import InputError
from zerobev.scenes.scene import Scene

_SAME_M = 1e-3  # faces of the two meshes with their centres this close are one face


def movable(scene: Scene) -> list[int]:
    """Ids of the instances that stand on the floor, are the size of furniture, and carry nothing."""
    lowest, highest = (np.full((len(scene.instance_label), 3), end) for end in (np.inf, -np.inf))
    corner = scene.vertices[scene.faces].astype(np.float64)
    np.minimum.at(lowest, scene.face_instance, corner.min(axis=1))
    np.maximum.at(highest, scene.face_instance, corner.max(axis=1))
    floor_m = np.median(highest[[i.id for i in scene.instances if i.name == "floor"], 2])
    found = []
    for instance in scene.instances:
        low, high = lowest[instance.id], highest[instance.id]
        stands = abs(low[2] - floor_m) < 0.05 and 0.2 < high[2] - low[2] < 1.6
        sized = 0.25 < max(high[:2] - low[:2]) < 1.3
        above = (scene.vertices[:, 2] > high[2] - 0.02) & (scene.vertices[:, 2] < high[2] + 0.1)
        over = above & ((scene.vertices[:, :2] > low[:2]) & (scene.vertices[:, :2] < high[:2])).all(axis=1)
        over[scene.faces[scene.face_instance == instance.id]] = False
        if stands and sized and not over.any():
            found.append(instance.id)
    return found


def moved(scene: Scene, instance: int, shift_m: np.ndarray) -> Scene:
    """The scene with one of its instances displaced by `shift_m` (3,) metres, world frame.

    Light is baked and stays: the shadow does not move along. Raises `InputError` where the photograph's mesh is not
    made of the annotation's faces, as it is in generated homes.
    """
    tree = cKDTree(scene.vertices[scene.faces].mean(axis=1))
    photograph = trimesh.Scene()
    for mesh in scene.photograph.dump():
        distance, face = tree.query(mesh.triangles.mean(axis=1))
        if distance.max() > _SAME_M:
            raise InputError(f"scene {scene.name}: expected one mesh as photograph and annotation, found two")
        turned = mesh.copy()
        turned.vertices[np.unique(mesh.faces[scene.face_instance[face] == instance])] += shift_m
        photograph.add_geometry(turned)
    vertices = scene.vertices.copy()
    vertices[np.unique(scene.faces[scene.face_instance == instance])] += np.asarray(shift_m, np.float32)
    return replace(scene, vertices=vertices, photograph=photograph)
