"""The shaders. Everything is drawn in the camera's frame: x right, y down, z ahead, metres.

`origin` is the camera in the frame of what is drawn and `turn` the rotation into the camera's frame, so that
large coordinates cancel before they are rounded. Pictures are low-passed to half a pixel (Williams 1983): an
image is the mean of at least three samples, which does the rest.
"""

from __future__ import annotations

_MIP_BIAS = -1.0  # level of detail, relative to a sample as large as a pixel

_PLACE_GLSL = """
#version 430
uniform mat3 turn;
uniform vec3 origin;
uniform mat4 projection;
in vec3 position;
vec4 place() { return projection * vec4(turn * (position - origin), 1.0); }
"""

ROOM_VERTEX = f"""{_PLACE_GLSL}
in vec2 uv;
in float layer;
in vec2 light_uv;
out vec3 picture_at;
out vec2 light_at;
void main() {{ gl_Position = place(); picture_at = vec3(uv, layer); light_at = light_uv; }}
"""

MOVER_VERTEX = f"""{_PLACE_GLSL}
uniform vec3 lamp;
uniform float light;
in vec3 normal;
in vec2 uv;
in float layer;
out vec3 picture_at;
out float shade;
void main() {{
    gl_Position = place();
    picture_at = vec3(uv, layer);
    shade = light * (1.0 + dot(lamp, normal));
}}
"""

FACE_VERTEX = f"{_PLACE_GLSL}void main() {{ gl_Position = place(); }}"


# Picture times light.
ROOM_FRAGMENT = f"""
#version 430
uniform sampler2DArray pictures;
uniform sampler2D light_map;
uniform float gain;
in vec3 picture_at;
in vec2 light_at;
out float radiance;
void main() {{
    radiance = gain * texture(pictures, picture_at, {_MIP_BIAS}).r * texture(light_map, light_at).r;
}}
"""

# Picture times one light, shaded by the normal.
MOVER_FRAGMENT = f"""
#version 430
uniform sampler2DArray pictures;
uniform float gain;
in vec3 picture_at;
in float shade;
out float radiance;
void main() {{ radiance = gain * texture(pictures, picture_at, {_MIP_BIAS}).r * shade; }}
"""

# On a plane, inverse depth is affine in normalised coordinates, which is more exact than interpolated depth.
# Doubles, because on a surface seen almost edge-on the last bit of u and v is 1e-5 m.
DEPTH_FRAGMENT = """
#version 430
layout(std430, binding = 0) readonly buffer Slopes { dvec4 slopes[]; };
uniform dvec2 focal;
uniform dvec2 centre;
out float depth;
void main() {
    dvec2 uv = (dvec2(gl_FragCoord.xy) - 0.5 - centre) / focal;
    depth = float(1.0 / dot(slopes[gl_PrimitiveID].xyz, dvec3(uv, 1.0)));
}
"""

# Triangle numbers as floats: exact below 2^24.
FACE_FRAGMENT = """
#version 430
uniform float first;
out float face;
void main() { face = first + float(gl_PrimitiveID); }
"""
