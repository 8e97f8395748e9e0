// Penetration of the hand's solids by sharp points of the object (optimize/problem.py, `feature_distance`).
#pragma once
#include "terms.hpp"

namespace graspd {

// Pairs are searched up to the farthest distance of the previous result plus this margin [m].
constexpr float CUT_MARGIN = 0.005f;

// Returns the signed distance of a point `at` to a solid, and writes the gradient. Both are in the solid's frame.
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

// Computes the pose of every solid of the hand.
static void place_solids(const Problem& p, Scratch& s) {
    for (int k = 0; k < p.solids.count; k++)
        compose(s.link + 12 * p.solids.link[k], p.solids.pose + 12 * k, s.solid + 12 * k);
}

// A lower bound of the distance of points to a solid: the greatest signed distance to a face of its bounding box.
struct Bound {
    Bound(const Solids& solids, int k, const float* placed) : t(placed) {
        const float *core = solids.core + 3 * k, radius = solids.radius[k];
        for (int i = 0; i < 3; i++) {
            origin[i] = t[i] * t[3] + t[4 + i] * t[7] + t[8 + i] * t[11];
            half[i] = core[i] + radius;
        }
    }
    Floats operator()(Floats x, Floats y, Floats z) const {
        Floats a = magnitude(t[0] * x + t[4] * y + t[8] * z - origin[0]) - half[0];
        Floats b = magnitude(t[1] * x + t[5] * y + t[9] * z - origin[1]) - half[1];
        Floats c = magnitude(t[2] * x + t[6] * y + t[10] * z - origin[2]) - half[2];
        return greater(greater(a, b), c);
    }
    const float* t;
    float origin[3], half[3];
};

// Computes distance bounds of pairs of solid and point, in all blocks that may be nearer than `most`. Returns how many.
static int bound_distances(const Problem& p, int features, float most, Scratch& s) {
    const float *fx = p.object.features, *fy = fx + p.object.feature_stride, *fz = fy + p.object.feature_stride;
    const int whole = padded(features), blocks = whole / LANES;
    int found = 0;
    for (int k = 0; k < p.solids.count; k++) {
        const Bound bound(p.solids, k, s.solid + 12 * k);
        for (int first = 0; first < blocks; first += LANES) {
            Floats nearest = bound(load(s.blocks.x + first), load(s.blocks.y + first), load(s.blocks.z + first));
            for (unsigned set = bits(nearest - load(s.blocks.reach + first) <= most); set; set &= set - 1) {
                const int block = first + __builtin_ctz(set), i = block * LANES;
                if (block >= blocks) break;
                store(s.bound + found * LANES, bound(load(fx + i), load(fy + i), load(fz + i)));
                for (int j = features; j < i + LANES; j++) s.bound[found * LANES + j - i] = INFINITY;
                s.bounded[found++] = k * whole + i;
            }
        }
    }
    return found * LANES;
}

// Finds the nearest pairs, as index solid · points + point. First it searches up to the last cut plus a margin. If this
// gives too few pairs, it searches everywhere.
static int nearest_pairs(const Problem& p, int features, Scratch& s) {
    const int wanted = std::min(p.feature_pairs, features * p.solids.count);
    const float most = s.cut_of_pairs + CUT_MARGIN;
    int found = least(s.bound, bound_distances(p, features, most, s), wanted, &s.cut_of_pairs, s.picked);
    if (found < wanted || s.cut_of_pairs > most)
        found = least(s.bound, bound_distances(p, features, INFINITY, s), wanted, &s.cut_of_pairs, s.picked);
    for (int m = 0; m < found; m++) s.picked[m] = s.bounded[s.picked[m] / LANES] + s.picked[m] % LANES;
    return found;
}

// Returns the signed distance of a sharp point to a solid, and writes the gradient in the point, object frame.
static float feature_distance(const Problem& p, int solid, int feature, float* gradient, Scratch& s) {
    const Solids& solids = p.solids;
    const float *t = s.solid + 12 * solid, *at = p.object.features + feature;
    float x = at[0] - t[3], y = at[p.object.feature_stride] - t[7], z = at[2 * p.object.feature_stride] - t[11];
    float local[3] = {t[0] * x + t[4] * y + t[8] * z, t[1] * x + t[5] * y + t[9] * z, t[2] * x + t[6] * y + t[10] * z};
    float slope[3];
    float distance = solid_distance(solids.core + 3 * solid, solids.radius[solid], solids.round[solid] != 0, local, slope);
    for (int r = 0; r < 3; r++) gradient[r] = t[4 * r] * slope[0] + t[4 * r + 1] * slope[1] + t[4 * r + 2] * slope[2];
    return distance;
}

// Finds for every placed solid the nearest sharp point, its distance, and the gradient of the distance.
static void nearest_features(const Problem& p, int32_t* pick, float* distance, float* gradient, Scratch& s) {
    const Object& object = p.object;
    for (int k = 0; k < p.solids.count; k++) {
        const Bound bound(p.solids, k, s.solid + 12 * k);
        pick[k] = 0;
        distance[k] = INFINITY;
        for (int first = 0; first < s.blocks.count; first += LANES) {
            Floats least = bound(load(s.blocks.x + first), load(s.blocks.y + first), load(s.blocks.z + first)) -
                           load(s.blocks.reach + first);
            for (int block = first; block < std::min(first + LANES, s.blocks.count); block++) {
                if (!(least[block - first] < distance[k])) continue;
                for (int i = block * LANES; i < std::min((block + 1) * LANES, object.feature_count); i++) {
                    float slope[3], d = feature_distance(p, k, i, slope, s);
                    if (!(d < distance[k])) continue;
                    pick[k] = i;
                    distance[k] = d;
                    memcpy(gradient + 3 * k, slope, sizeof slope);
                }
            }
        }
    }
}

// Returns the sharp point deepest in a solid, or -1 if no point is inside. Writes its depth and distance gradient.
static int deepest_feature(const Problem& p, int k, float* depth, float* gradient, Scratch& s) {
    const Object& object = p.object;
    const float *x = object.features, *y = x + object.feature_stride, *z = y + object.feature_stride;
    const Bound bound(p.solids, k, s.solid + 12 * k);
    int found = -1;
    *depth = 0;
    for (int first = 0; first < s.blocks.count; first += LANES) {
        Floats least = bound(load(s.blocks.x + first), load(s.blocks.y + first), load(s.blocks.z + first)) -
                       load(s.blocks.reach + first);
        for (unsigned set = bits(least < -*depth); set; set &= set - 1) {
            const int at = (first + __builtin_ctz(set)) * LANES;
            if (at >= object.feature_count) break;
            for (unsigned in = bits(bound(load(x + at), load(y + at), load(z + at)) < -*depth); in; in &= in - 1) {
                const int i = at + __builtin_ctz(in);
                float slope[3];
                if (i >= object.feature_count) break;
                const float d = -feature_distance(p, k, i, slope, s);
                if (!(d > *depth)) continue;
                found = i;
                *depth = d;
                memcpy(gradient, slope, sizeof slope);
            }
        }
    }
    return found;
}

// Adds the loss of the nearest pairs, and sets their adjoints. A pair also sets the gap of its group if it is nearer.
static int sharp_points(const Problem& p, int features, float weight, float* penetration, Scratch& s) {
    const Solids& solids = p.solids;
    if (features == 0 || solids.count == 0) return 0;
    place_solids(p, s);
    const int whole = padded(features), pairs = nearest_pairs(p, features, s);
    for (int m = 0; m < pairs; m++) {
        float steep;
        Pair& pair = s.pair[m];
        pair.solid = s.picked[m] / whole;
        pair.feature = s.picked[m] % whole;
        pair.distance = feature_distance(p, pair.solid, pair.feature, pair.gradient, s);
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

// Adds the forces of the pairs to the links. The point is fixed, so a link is pushed against the gradient.
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
