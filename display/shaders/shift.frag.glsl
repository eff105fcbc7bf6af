// Planes shifted against each other by what an inclined look along them would do, and the brightest or the sum of them.
#include "camera.glsl"
#include "volume.glsl"
#include "shade.glsl"
uniform vec2 slope;  // voxels that a plane is shifted for each plane behind the middle
uniform bool whole;  // shifts are rounded to whole voxels

out vec4 colour;

void main() {
    vec2 at = (corner + (gl_FragCoord.x - 0.5) * right + (gl_FragCoord.y - 0.5) * down).xy;
    int depth = int(voxels.z);
    float best = -1.0;
    for (int k = 0; k < depth; ++k) {
        vec2 shift = slope * (float(k) - 0.5 * float(depth - 1));
        vec2 place = at - (whole ? floor(shift + 0.5) : shift);
        if (all(greaterThanEqual(place, vec2(-0.5))) && all(lessThanEqual(place, voxels.xy - 0.5)))
            best = max(best, raw_value(vec3(place, float(k))));
    }
    float v = clamp((best - limits.x) / (limits.y - limits.x), 0.0, 1.0);
    colour = best >= 0.0 ? vec4(table_colour(v), 1.0) : vec4(0.0);
}
