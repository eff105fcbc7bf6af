// Light and absorption front to back; independent of the step because matter absorbs exponentially.
uniform sampler2D transfer;  // light and absorption per µm of 256 values
uniform sampler3D reaching;  // share of the light that reaches each place
uniform bool self_shadow;
vec3 light = vec3(0.0);
float left = 1.0, last = 0.0;
bool before = false;
vec4 nothing() { return vec4(0.0); }
void begin(Ray ray, vec2 span) { last = span.x; }

void glimpse(Ray ray, float inside, float outside) {
    for (int k = 0; k < 5; ++k) {
        float middle = 0.5 * (inside + outside);
        if (value(ray.from + middle * ray.dir) >= threshold) inside = middle; else outside = middle;
    }
    vec3 change = gradient(ray.from + inside * ray.dir);
    light += left * surface * lit(-change / max(length(change), 1e-9), normalize(ray.dir * voxel_um), vec3(1.0));
    left *= 1.0 - surface;
}

bool visit(Ray ray, float t, float ds) {
    vec3 place = ray.from + t * ray.dir;
    float v = value(place);
    bool inside = v >= threshold;
    if (surface > 0.0 && inside != before) glimpse(ray, inside ? t : last, inside ? last : t);
    before = inside;
    last = t;
    vec4 matter = texture(transfer, vec2((v * 255.0 + 0.5) / 256.0, 0.5));
    float through = exp(-matter.a * ds);
    float reached = self_shadow ? texture(reaching, (place + 0.5) / voxels).r : 1.0;
    light += left * (1.0 - through) * reached * matter.rgb;
    left *= through;
    return left <= 0.005;
}

vec4 end(Ray ray) { return vec4(light, 1.0 - left); }
