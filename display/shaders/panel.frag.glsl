// Shows a finished picture in a panel, whose rows are counted from above.
uniform sampler2D picture;
uniform vec2 window;

out vec4 colour;

void main() {
    vec2 size = vec2(textureSize(picture, 0));
    float scale = min(window.x / size.x, window.y / size.y);
    vec2 at = (gl_FragCoord.xy - 0.5 * (window - scale * size)) / (scale * size);
    bool inside = all(greaterThanEqual(at, vec2(0.0))) && all(lessThan(at, vec2(1.0)));
    colour = inside ? vec4(texture(picture, at).rgb, 1.0) : vec4(vec3(0.06), 1.0);
}
