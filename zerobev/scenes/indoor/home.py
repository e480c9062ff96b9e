"""From a random generator to a complete `Scene`: plan, furnish, unwrap, bake, paint."""

from dataclasses import dataclass

import numpy as np
import trimesh
from PIL import Image
from trimesh.visual.material import PBRMaterial
from trimesh.visual.texture import TextureVisuals

from zerobev.config import Homes
from zerobev.scenes.categories import label_of
from zerobev.scenes.indoor.atlas import TEXELS_PER_M, Atlas, unwrap
from zerobev.scenes.indoor.buildings import draw_building
from zerobev.scenes.indoor.furnish import furnish
from zerobev.scenes.indoor.light import Lamp, LightMap, bake
from zerobev.scenes.indoor.paint import paint
from zerobev.scenes.indoor.plan import draw_plan
from zerobev.scenes.indoor.shell import build_shell
from zerobev.scenes.indoor.solids import Material, tops_above, unseen
from zerobev.scenes.indoor.style import FLATS, Style, draw_style
from zerobev.scenes.scene import Instance, Scene

#: Height of the cut through varied homes on the map; it shows surfaces that nobody sees.
_CUT_M = 1.95


@dataclass(frozen=True)
class Home:
    """A home without its atlas: Q quads with their owners and materials."""

    kinds: list[str]  #: kind of each room, by region
    names: list[str]  #: of each instance; entry i has id i + 1
    regions: list[int]  #: room number of each instance
    quads: np.ndarray  #: (Q, 4, 3) float32, metres
    owner: np.ndarray  #: (Q,) instance id, >= 1
    hidden: np.ndarray  #: (Q,) bool
    materials: list[Material]  #: Q
    lamps: list[Lamp]
    style: Style

    @property
    def instances(self) -> tuple[Instance, ...]:
        """One per instance; colours follow a fixed permutation of 24-bit numbers, so they are unique."""
        rows = []
        for index, (name, region) in enumerate(zip(self.names, self.regions), start=1):
            code = index * 0x9E3779 % 0x1000000  # odd factor: a bijection that maps 0 to 0
            rows.append(Instance(index, (code >> 16, code >> 8 & 255, code & 255), name, region, label_of(name)))
        return tuple(rows)


def build_home(rng: np.random.Generator, homes: Homes = "flats") -> Home:
    """A furnished floor plan."""
    if homes == "flats":
        style, rooms = FLATS, draw_plan(rng)
    else:
        style, rooms = draw_style(rng), draw_building(rng)
    names, regions, solids, lamps = [], [], [], []
    for region, room in enumerate(rooms):
        for items, light in (build_shell(rng, room, style), furnish(rng, room, style)):
            lamps.extend(light)
            for name, solid in items:
                names.append(name)
                regions.append(region)
                solids.append(solid)
    counts = [len(solid.quads) for solid in solids]
    quads = np.concatenate([solid.quads for solid in solids]).astype(np.float32)
    hidden = np.concatenate([solid.hidden for solid in solids]) | unseen(quads)
    if homes == "varied":
        hidden &= ~tops_above(quads, _CUT_M)
        lamps = [style.shines(rng, lamp) for lamp in lamps]
    return Home(
        kinds=[room.kind for room in rooms],
        names=names,
        regions=regions,
        quads=quads,
        owner=np.repeat(np.arange(1, len(names) + 1), counts),
        hidden=hidden,
        materials=[style.of(name, material) for name, solid in zip(names, solids) for material in solid.materials],
        lamps=lamps,
        style=style,
    )


def generate_home(name: str, rng: np.random.Generator, homes: Homes = "flats") -> Scene:
    """A furnished home with atlas, annotation and photographed textures, in place of HM3DSem (paper, Section 5).

    Kinds and numbers of rooms and furniture of "flats" follow HM3DSem's; "varied" homes differ more from each other: in
    their plans, styles, light, amount and sizes of furniture. Light is baked into the textures (`unlit`), except in
    some varied homes. Ceilings face down, all other solids are closed. Texels are 1 cm. The same state of `rng` gives
    the same bytes.
    """
    home = build_home(rng, homes)
    quads = home.quads.astype(np.float64)
    atlas = unwrap(quads, home.hidden)
    faces, quad_of_face, corner = _triangles(quads)
    size_m = np.stack([np.ptp(atlas.corners[:, :, axis], axis=1) for axis in (1, 0)], axis=1) / TEXELS_PER_M
    albedo = np.array([(m.color, m.second) for m in home.materials]).mean(axis=1) ** 2
    opaque = np.array([not m.glow for m in home.materials])
    style = home.style
    if style.baked:
        frame = atlas.origin, atlas.right, atlas.down
        light = bake(quads, *frame, size_m, faces, albedo, home.lamps, home.hidden, opaque, style.directions)
        light = light if style.key is None else light.exposed(albedo, style.key)
    else:
        light = LightMap.uniform(len(quads))
    textures = paint(atlas, home.hidden, home.materials, light, style.exposure, style.shoulder)
    face_uv = atlas.uv[quad_of_face[:, None], corner]
    face_chart = atlas.chart[quad_of_face]
    vertices = home.quads.reshape(-1, 3)
    return Scene(
        name=name,
        vertices=vertices,
        faces=faces,
        face_uv=face_uv,
        face_chart=face_chart,
        chart_instance=atlas.owner_images(home.owner),
        instances=home.instances,
        photograph=_photograph(atlas, vertices, faces, face_chart, textures),
        unlit=style.baked,
        double_sided=False,
    )


def _triangles(quads: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(F, 3) int32 faces over the quads' corners, (F,) their quads, (F, 3) their corners; no face without area."""
    corner = np.tile([[0, 1, 2], [0, 2, 3]], (len(quads), 1))
    quad = np.repeat(np.arange(len(quads)), 2)
    is_triangle = (quads[:, 2] == quads[:, 3]).all(axis=1)
    keep = np.ones(len(quad), bool)
    keep[1::2] = ~is_triangle
    quad, corner = quad[keep], corner[keep]
    return (quad[:, None] * 4 + corner).astype(np.int32), quad, corner


def _photograph(
    atlas: Atlas, vertices: np.ndarray, faces: np.ndarray, face_chart: np.ndarray, textures: list[np.ndarray]
) -> trimesh.Scene:
    """One textured geometry per chart."""
    scene = trimesh.Scene()
    uv = atlas.uv.reshape(-1, 2) * [1, -1] + [0, 1]  # trimesh has v = 0 at the bottom
    for chart, texture in enumerate(textures):
        used, local = np.unique(faces[face_chart == chart], return_inverse=True)
        material = PBRMaterial(
            name=f"chart{chart}",
            baseColorTexture=Image.fromarray(texture),
            metallicFactor=0.0,
            roughnessFactor=1.0,
            doubleSided=False,
        )
        mesh = trimesh.Trimesh(
            vertices[used], local.reshape(-1, 3), visual=TextureVisuals(uv[used], material=material), process=False
        )
        scene.add_geometry(mesh, geom_name=f"chart{chart}")
    return scene
