// Values of a volume between 0 and 1.
uniform sampler3D volume;
uniform vec3 voxels;  // of the volume; its texture has fewer where it would be too large
uniform vec2 limits;  // of the texture's own values
uniform vec3 low, high;  // corners of what is shown, in voxels

float raw_value(vec3 at) {
    return texture(volume, (at + 0.5) / voxels).r;
}

float value(vec3 at) {
    return clamp((raw_value(at) - limits.x) / (limits.y - limits.x), 0.0, 1.0);
}

// Change of the value per µm, central differences over one voxel to each side.
vec3 gradient(vec3 at) {
    const vec2 one = vec2(1.0, 0.0);
    vec3 change = vec3(raw_value(at + one.xyy) - raw_value(at - one.xyy),
                       raw_value(at + one.yxy) - raw_value(at - one.yxy),
                       raw_value(at + one.yyx) - raw_value(at - one.yyx));
    return change / (2.0 * voxel_um) / (limits.y - limits.x);
}
