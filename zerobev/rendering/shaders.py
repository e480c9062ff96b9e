"""Shaders with features that pyrender's lack: alpha cutoffs, and colour factors in linear light."""

import shutil
import tempfile
from pathlib import Path
from typing import Any

from pyrender.renderer import Renderer
from pyrender.shader_program import ShaderProgram, ShaderProgramCache

from zerobev.rendering.opengl import pyrender

_CUTOFF = "uniform float alpha_cutoff;\n"

# pyrender sets uniforms and vertex attributes by these names
_FLAT = (
    """#version 330 core
struct Material {
    vec4 base_color_factor;
#ifdef HAS_BASE_COLOR_TEX
    sampler2D base_color_texture;
#endif
};
uniform Material material;
"""
    + _CUTOFF
    + """
#ifdef TEXCOORD_0_LOC
in vec2 uv_0;
#endif
#ifdef COLOR_0_LOC
in vec4 color_multiplier;
#endif
out vec4 frag_color;

vec3 to_linear(vec3 srgb) {
    return mix(srgb / 12.92, pow((srgb + 0.055) / 1.055, vec3(2.4)), step(0.04045, srgb));
}

vec3 to_srgb(vec3 linear) {
    return mix(linear * 12.92, 1.055 * pow(linear, vec3(1.0 / 2.4)) - 0.055, step(0.0031308, linear));
}

void main() {
    vec4 tint = material.base_color_factor;
    vec4 texel = vec4(1.0);
#ifdef HAS_BASE_COLOR_TEX
    texel = texture(material.base_color_texture, uv_0);
#endif
#ifdef COLOR_0_LOC
    tint *= color_multiplier;
#endif
    float alpha = tint.a * texel.a;
    if (alpha < alpha_cutoff) discard;
    // a white tint leaves texels exactly unchanged
    vec3 color = tint.rgb == vec3(1.0) ? texel.rgb : to_srgb(to_linear(texel.rgb) * tint.rgb);
    frag_color = clamp(vec4(color, alpha), 0.0, 1.0);
}
"""
)


class SurfaceRenderer(Renderer):
    """pyrender's renderer, without fragments with alpha below their material's `alphaCutoff`.

    With the flag FLAT a fragment is the product of texture, base colour and vertex colour in linear light.
    """

    def __init__(self, width_px: int, height_px: int) -> None:
        super().__init__(width_px, height_px)
        self._folder = tempfile.TemporaryDirectory(prefix="shaders-")  # pyrender reads shaders at their first use
        folder = Path(self._folder.name) / "shaders"
        shutil.copytree(Path(pyrender.__file__).with_name("shaders"), folder)
        (folder / "flat.frag").write_text(_FLAT)
        lit = (folder / "mesh.frag").read_text()
        lit = lit.replace("uniform vec3 cam_pos;\n", "uniform vec3 cam_pos;\n" + _CUTOFF)
        lit = lit.replace(
            "    frag_color =", "    if (color.a * base_color.a < alpha_cutoff) discard;\n    frag_color =", 1
        )
        (folder / "mesh.frag").write_text(lit)
        self._program_cache = ShaderProgramCache(str(folder))

    def _bind_and_draw_primitive(
        self, primitive: pyrender.Primitive, pose: Any, program: ShaderProgram, flags: int
    ) -> None:
        program.set_uniform("alpha_cutoff", primitive.material.alphaCutoff)
        super()._bind_and_draw_primitive(primitive, pose, program, flags)
