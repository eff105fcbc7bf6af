float best = 2.0, where = 0.0;
vec4 nothing() { return vec4(0.0); }
void begin(Ray ray, vec2 span) {}

bool visit(Ray ray, float t, float ds) {
    float v = value(ray.from + t * ray.dir);
    if (v < best) { best = v; where = t; }
    return best <= 0.0;
}

vec4 end(Ray ray) { return vec4(best, where, 1.0, 0.0); }
