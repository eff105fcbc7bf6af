// A pixel of a mesh: its paint, its light, and lines of equal height on it.
#define UNLIT 0
#define FLAT 1
#define GOURAUD 2
#define PHONG 3
#define PLAIN 0   // one colour
#define TABLED 1  // a colour of the table by tone.z
#define DRAPED 2  // the picture at tone.xy
#define OWN 3     // tone itself: linear light and opacity
#include "shade.glsl"
uniform vec3 along, eye;
uniform bool perspective;
uniform float cycles;    // how often the table is run through
uniform float contours;  // lines of equal height from the lowest to the highest; 0: none
uniform float first_contour;
uniform sampler2D drape;  // linear light

in vec3 place;
in vec3 upright;
in vec4 tone_here;
in vec2 light_here;
out vec4 colour;

vec4 paint() {
#if PAINT == TABLED
    float share = tone_here.z * cycles;
    return vec4(table_colour(cycles == 1.0 ? share : fract(share)), 1.0);
#elif PAINT == DRAPED
    return vec4(texture(drape, tone_here.xy).rgb, 1.0);
#elif PAINT == OWN
    return tone_here;
#else
    return vec4(surface_colour, 1.0);
#endif
}

// A normal between points may look away from a viewer who sees the facet's front: then it is seen edge on.
vec3 towards_viewer(vec3 n, vec3 way) {
    vec3 facet = cross(dFdx(place), dFdy(place));
    bool front = dot(facet, way) * dot(facet, n) < 0.0;
    return front && dot(n, way) > 0.0 ? normalize(n - 1.001 * dot(n, way) * way) : n;
}

vec3 answered(vec3 paint) {
#if SHADING == UNLIT
    return paint;
#elif SHADING == GOURAUD
    return paint * light_here.x + light_here.y;
#else
    vec3 way = normalize(perspective ? place - eye : along);
#if SHADING == FLAT
    vec3 n = normalize(cross(dFdx(place), dFdy(place)));
#else
    vec3 n = towards_viewer(normalize(upright), way);
#endif
    return lit(n, way, paint);
#endif
}

// How much of the paint is left beside a line of equal height; lines are one pixel wide, smoothed.
float beside_line() {
    if (contours <= 0.0) return 1.0;
    float step = tone_here.z * contours - first_contour;
    float away = abs(fract(step + 0.5) - 0.5) / max(fwidth(step), 1e-9);
    return clamp(away - 0.25, 0.15, 1.0);
}

void main() {
    vec4 own = paint();
    colour = vec4(answered(own.rgb) * beside_line() * own.a, own.a);
}
