// A point of a mesh: where it is seen, and its light where that is worked out for points.
#include "shade.glsl"
uniform mat4 clip;
uniform vec3 along, eye;
uniform bool perspective;
uniform float behind;  // moves the surface back, so that lines on it are seen

in vec3 position;
in vec3 normal;
in vec4 tone;

out vec3 place;
out vec3 upright;
out vec4 tone_here;
out vec2 light_here;  // what multiplies the colour, what is mirrored

void main() {
    vec3 way = normalize(perspective ? position - eye : along);
    float mirrored = lit(normal, way, vec3(0.0)).r;
    light_here = vec2(lit(normal, way, vec3(1.0)).r - mirrored, mirrored);
    place = position;
    upright = normal;
    tone_here = tone;
    gl_Position = clip * vec4(position, 1.0);
    gl_Position.z += behind * gl_Position.w;
}
