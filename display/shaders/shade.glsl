// From what a ray saw to linear light, premultiplied by alpha.
#define TABLE 0    // (value, distance, seen, -): a colour of the table
#define SURFACE 1  // (normal, distance): a lit surface; normal 0 is nothing
#define COLOUR 2   // light and alpha themselves
#define THROUGH 3  // (Σ value · length, -, -, -): what comes through, as a colour of the table
#define DEPTH 4    // (-, distance, seen, -): the distance as a colour of the table
uniform sampler2D table;  // linear light of 256 values
uniform vec3 to_light;
uniform vec4 answer;  // ambient, diffuse, specular, shininess
uniform vec3 surface_colour;
uniform float gain;  // of what was summed
uniform float threshold;
uniform vec2 depths;  // that are the ends of the table, µm from the screen plane

vec3 table_colour(float v) {
    return texture(table, vec2((clamp(v, 0.0, 1.0) * 255.0 + 0.5) / 256.0, 0.5)).rgb;
}

// Ambient, diffuse and mirrored light (Blinn 1977) of a surface seen from both sides.
vec3 lit(vec3 normal, vec3 dir_um, vec3 colour) {
    vec3 n = faceforward(normal, dir_um, normal);
    vec3 halfway = normalize(to_light - dir_um);
    float diffuse = max(dot(n, to_light), 0.0);
    float mirrored = diffuse > 0.0 ? pow(max(dot(n, halfway), 0.0), answer.w) : 0.0;
    return colour * (answer.x + answer.y * diffuse) + answer.z * mirrored;
}

vec4 shade(vec4 seen, vec3 dir_um) {
#if SHADE == TABLE
    return seen.z > 0.0 ? vec4(table_colour(seen.x * gain), 1.0) : vec4(0.0);
#elif SHADE == SURFACE
    return dot(seen.xyz, seen.xyz) > 0.0 ? vec4(lit(seen.xyz, dir_um, surface_colour), 1.0) : vec4(0.0);
#elif SHADE == THROUGH
    return vec4(table_colour(exp(-gain * seen.x)), 1.0);
#elif SHADE == DEPTH
    return seen.z > 0.0 && seen.x >= threshold ? vec4(table_colour((seen.y - depths.x) / (depths.y - depths.x)), 1.0) : vec4(0.0);
#else
    return seen;
#endif
}
