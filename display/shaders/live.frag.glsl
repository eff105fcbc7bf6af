// A camera frame with its contrast: grey levels between two limits, gamma, a colour table; the ends of the scale hatched.
uniform sampler2D frame;
uniform sampler2D table;
uniform float full;
uniform vec2 limits;
uniform float top;
uniform float gamma;
uniform bool paint;
uniform bool coloured;
uniform vec2 corner;
uniform float scale;

out vec4 colour;

const vec3 OVER = vec3(1.0, 0.35, 0.0);
const vec3 UNDER = vec3(0.0, 0.45, 1.0);
const vec3 BESIDE = vec3(0.06);

vec3 stretched(vec3 levels) {
    return pow(clamp((levels - limits.x) / (limits.y - limits.x), 0.0, 1.0), vec3(1.0 / gamma));
}

void main() {
    ivec2 pixel = ivec2(floor((gl_FragCoord.xy - corner) / scale));
    ivec2 size = textureSize(frame, 0);
    if (any(lessThan(pixel, ivec2(0))) || any(greaterThanEqual(pixel, size))) {
        colour = vec4(BESIDE, 1.0);
        return;
    }
    vec3 levels = texelFetch(frame, pixel, 0).rgb * full;
    if (!coloured) levels = levels.rrr;
    vec3 shown = stretched(levels);
    shown = coloured ? shown : texture(table, vec2(0.5 / 256.0 + shown.r * 255.0 / 256.0, 0.5)).rgb;
    float most = max(levels.r, max(levels.g, levels.b));
    bool rising = mod(gl_FragCoord.x + gl_FragCoord.y, 8.0) < 4.0;
    bool falling = mod(gl_FragCoord.x - gl_FragCoord.y, 8.0) < 4.0;
    if (paint && most >= top - 0.5 && rising) shown = OVER;
    if (paint && most < 0.5 && falling) shown = UNDER;
    colour = vec4(shown, 1.0);
}
