"""The shaders. A surface is drawn in the camera's frame: x right, y down, z ahead, metres.

`origin` is the camera in the frame of what is drawn and `turn` the rotation into the camera's frame, so
that the large coordinates cancel before anything is rounded.
"""

from __future__ import annotations

_VERTEX = """
#version 430
uniform mat3 turn;
uniform vec3 origin;
uniform mat4 projection;
in vec3 position;
vec4 place() { return projection * vec4(turn * (position - origin), 1.0); }
"""

ROOM_VERTEX = (
    _VERTEX
    + """
in vec2 uv;
in float layer;
in vec2 light_uv;
out vec3 picture_at;
out vec2 light_at;
void main() { gl_Position = place(); picture_at = vec3(uv, layer); light_at = light_uv; }
"""
)

ROOM_FRAGMENT = """
#version 430
uniform sampler2DArray pictures;
uniform sampler2D light_map;
uniform float gain;
uniform float lod_bias;
in vec3 picture_at;
in vec2 light_at;
out float radiance;
void main() {
    radiance = gain * texture(pictures, picture_at, lod_bias).r * texture(light_map, light_at).r;
}
"""

MOVER_VERTEX = (
    _VERTEX
    + """
uniform vec3 lamp;
uniform float light;
in vec3 normal;
in vec2 uv;
in float layer;
out vec3 picture_at;
out float shade;
void main() {
    gl_Position = place();
    picture_at = vec3(uv, layer);
    shade = light * (1.0 + dot(lamp, normal));
}
"""
)

MOVER_FRAGMENT = """
#version 430
uniform sampler2DArray pictures;
uniform float gain;
uniform float lod_bias;
in vec3 picture_at;
in float shade;
out float radiance;
void main() { radiance = gain * texture(pictures, picture_at, lod_bias).r * shade; }
"""

DEPTH_VERTEX = _VERTEX + "void main() { gl_Position = place(); }"

# On a plane, inverse depth is affine in normalised coordinates: no interpolation can be as exact.
DEPTH_FRAGMENT = """
#version 430
layout(std430, binding = 0) readonly buffer Planes { vec4 planes[]; };
uniform vec2 focal;
uniform vec2 centre;
out float depth;
void main() {
    vec2 uv = (gl_FragCoord.xy - 0.5 - centre) / focal;
    depth = 1.0 / dot(planes[gl_PrimitiveID].xyz, vec3(uv, 1.0));
}
"""
