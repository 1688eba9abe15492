"""GLSL of the rasteriser: colour, camera z and instance; camera z and instance; or camera z alone."""

VERTEX_SHADER = """
#version 330
uniform mat4 clip_from_cam;
uniform mat4 cam_from_obj;
in vec3 position;
in vec3 normal;
in vec3 colour;
in vec2 uv;
out vec3 p_cam;
out vec3 n_cam;
out vec3 base;
out vec2 texcoord;
void main() {
    vec4 p = cam_from_obj * vec4(position, 1.0);
    p_cam = p.xyz;
    n_cam = mat3(cam_from_obj) * normal;
    base = colour;
    texcoord = uv;
    gl_Position = clip_from_cam * p;
}
"""

# Two-sided: many CAD meshes have flipped faces, so the normal is turned towards the camera.
FRAGMENT_SHADER = """
#version 330
uniform sampler2D image;
uniform bool textured;
uniform bool coloured;
uniform vec3 tint;
uniform float ambient;
uniform float diffuse;
uniform int n_lights;
uniform vec3 light_direction[8];
uniform vec3 light_rgb[8];
uniform float instance;
in vec3 p_cam;
in vec3 n_cam;
in vec3 base;
in vec2 texcoord;
layout(location = 0) out vec4 rgb;
layout(location = 1) out vec2 depth_instance;
vec3 linear(vec3 c) {
    return mix(c / 12.92, pow((c + 0.055) / 1.055, vec3(2.4)), vec3(greaterThan(c, vec3(0.04045))));
}
vec3 display(vec3 c) {
    return mix(c * 12.92, 1.055 * pow(c, vec3(1.0 / 2.4)) - 0.055, vec3(greaterThan(c, vec3(0.0031308))));
}
void main() {
    vec3 to_eye = normalize(-p_cam);
    vec3 n = dot(n_cam, n_cam) > 1e-12 ? normalize(n_cam) : to_eye;
    if (dot(n, to_eye) < 0.0) n = -n;
    vec3 light = vec3(ambient);
    if (n_lights == 0) light += diffuse * dot(n, to_eye);
    for (int i = 0; i < n_lights; ++i) light += diffuse * light_rgb[i] * max(dot(n, light_direction[i]), 0.0);
    vec3 own = textured ? texture(image, texcoord).rgb : base;
    if (textured && coloured) own = display(linear(own) * linear(base));
    rgb = vec4(min(own * tint * light, 1.0), instance / 255.0);
    depth_instance = vec2(p_cam.z, instance);
}
"""

# Where no colours are asked for: a triangle that has less to interpolate costs the software renderer less.
DEPTH_VERTEX_SHADER = """
#version 330
uniform mat4 clip_from_cam;
uniform mat4 cam_from_obj;
in vec3 position;
out float z_cam;
void main() {
    vec4 p = cam_from_obj * vec4(position, 1.0);
    z_cam = p.z;
    gl_Position = clip_from_cam * p;
}
"""

DEPTH_FRAGMENT_SHADER = """
#version 330
in float z_cam;
layout(location = 0) out float depth;
void main() { depth = z_cam; }
"""

LABEL_FRAGMENT_SHADER = """
#version 330
uniform float instance;
in float z_cam;
layout(location = 0) out vec2 depth_instance;
void main() { depth_instance = vec2(z_cam, instance); }
"""
