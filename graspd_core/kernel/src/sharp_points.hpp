// The object's sharp points against the hand's solids (methods/problem.py, `feature_distance`).
#pragma once
#include "terms.hpp"

namespace graspd {

// Signed distance of a point to a solid, both in the solid's frame, and its gradient there.
static float solid_distance(const float* core, float radius, bool round, const float* at, float* gradient) {
    float side[3] = {at[0] < 0 ? -1.f : 1.f, at[1] < 0 ? -1.f : 1.f, at[2] < 0 ? -1.f : 1.f};
    float across = round ? sqrtf(at[0] * at[0] + at[1] * at[1]) : 0.f;
    float past[3] = {(round ? across : fabsf(at[0])) - core[0], (round ? 0.f : fabsf(at[1])) - core[1],
                     fabsf(at[2]) - core[2]};
    float out[3], squared = 0;
    int most = 0;
    for (int i = 0; i < 3; i++) {
        out[i] = past[i] > 0 ? past[i] : 0.f;
        squared += out[i] * out[i];
        if (past[i] > past[most]) most = i;
    }
    float length = sqrtf(squared), slope[3];
    for (int i = 0; i < 3; i++) slope[i] = length > 1e-12f ? out[i] / length : 0.f;
    if (past[most] < 0) slope[most] += 1.f;
    if (round) {
        float inverse = across > 1e-12f ? slope[0] / across : 0.f;
        gradient[0] = inverse * at[0];
        gradient[1] = inverse * at[1];
    } else {
        gradient[0] = slope[0] * side[0];
        gradient[1] = slope[1] * side[1];
    }
    gradient[2] = slope[2] * side[2];
    return length + (past[most] < 0 ? past[most] : 0.f) - radius;
}

// A lower bound of the distance of every point to every solid: the largest coordinate beyond its bounding box.
static void bound_distances(const Problem& p, int features, Scratch& s) {
    const Solids& solids = p.solids;
    const float *fx = p.object.features, *fy = fx + p.object.feature_stride, *fz = fy + p.object.feature_stride;
    const int whole = padded(features);
    for (int k = 0; k < solids.count; k++) {
        float* t = s.solid + 12 * k;
        compose(s.link + 12 * solids.link[k], solids.pose + 12 * k, t);
        const float *core = solids.core + 3 * k, radius = solids.radius[k];
        float ox = t[0] * t[3] + t[4] * t[7] + t[8] * t[11], oy = t[1] * t[3] + t[5] * t[7] + t[9] * t[11],
              oz = t[2] * t[3] + t[6] * t[7] + t[10] * t[11];
        for (int i = 0; i < whole; i += LANES) {
            Floats x = load(fx + i), y = load(fy + i), z = load(fz + i);
            Floats a = magnitude(t[0] * x + t[4] * y + t[8] * z - ox) - (core[0] + radius);
            Floats b = magnitude(t[1] * x + t[5] * y + t[9] * z - oy) - (core[1] + radius);
            Floats c = magnitude(t[2] * x + t[6] * y + t[10] * z - oz) - (core[2] + radius);
            store(s.bound + k * whole + i, greater(greater(a, b), c));
        }
        for (int i = features; i < whole; i++) s.bound[k * whole + i] = INFINITY;
    }
}

// Depth of the nearest pairs; their adjoints begin, and groups learn of pairs that are nearer than their candidates.
static int sharp_points(const Problem& p, int features, float weight, float* penetration, Scratch& s) {
    const Solids& solids = p.solids;
    const Object& object = p.object;
    if (features == 0 || solids.count == 0) return 0;
    bound_distances(p, features, s);
    const int whole = padded(features);
    int pairs = least(s.bound, solids.count * whole, std::min(p.feature_pairs, features * solids.count), s.picked);
    for (int m = 0; m < pairs; m++) {
        Pair& pair = s.pair[m];
        pair.solid = s.picked[m] / whole;
        pair.feature = s.picked[m] % whole;
        const float* t = s.solid + 12 * pair.solid;
        float x = object.features[pair.feature] - t[3], y = object.features[object.feature_stride + pair.feature] - t[7],
              z = object.features[2 * object.feature_stride + pair.feature] - t[11];
        float local[3] = {t[0] * x + t[4] * y + t[8] * z, t[1] * x + t[5] * y + t[9] * z, t[2] * x + t[6] * y + t[10] * z};
        float slope[3], steep;
        pair.distance = solid_distance(
            solids.core + 3 * pair.solid, solids.radius[pair.solid], solids.round[pair.solid] != 0, local, slope);
        for (int r = 0; r < 3; r++)
            pair.gradient[r] = t[4 * r] * slope[0] + t[4 * r + 1] * slope[1] + t[4 * r + 2] * slope[2];
        *penetration += tempered(-pair.distance, &steep);
        pair.adjoint = -weight * steep;
        int group = solids.group[pair.solid];
        if (group >= 0 && pair.distance < s.gap[group]) {
            s.gap[group] = pair.distance;
            s.gap_pair[group] = m;
        }
    }
    return pairs;
}

// The hand moves, the point stays: the link is pushed against the gradient, at the point.
static void push_pairs(const Problem& p, int pairs, Scratch& s) {
    const Object& object = p.object;
    for (int m = 0; m < pairs; m++) {
        const Pair& pair = s.pair[m];
        if (pair.adjoint == 0) continue;
        const float* at = object.features + pair.feature;
        push(s.wrench + 6 * p.solids.link[pair.solid], at[0], at[object.feature_stride], at[2 * object.feature_stride],
             -pair.adjoint * pair.gradient[0], -pair.adjoint * pair.gradient[1], -pair.adjoint * pair.gradient[2]);
    }
}

}  // namespace graspd
