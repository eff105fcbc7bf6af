// Shows what the processor found of shifted planes: one value for each voxel, larger than a plane on all sides.
#include "camera.glsl"
#include "shade.glsl"
uniform sampler2D found;
uniform vec2 limits, origin;

out vec4 colour;

void main() {
    vec2 at = (corner + (gl_FragCoord.x - 0.5) * right + (gl_FragCoord.y - 0.5) * down).xy - origin + 0.5;
    vec2 size = vec2(textureSize(found, 0));
    bool inside = all(greaterThanEqual(at, vec2(0.0))) && all(lessThanEqual(at, size));
    float v = clamp((texture(found, at / size).r - limits.x) / (limits.y - limits.x), 0.0, 1.0);
    colour = inside ? vec4(table_colour(v), 1.0) : vec4(0.0);
}
