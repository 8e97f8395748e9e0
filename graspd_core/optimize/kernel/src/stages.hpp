// Pregrasp, settling and self-collision of optimised poses (optimize/grasp_postures.py, hands/self_collision.py).
#pragma once
#include "search.hpp"
#include "solid_overlap.hpp"

namespace graspd {

// The path from pregrasp to grasp is kept clear where these shares of the path are still to go.
constexpr int WAY = 3;
constexpr float TO_GO[WAY] = {1.f, 0.6f, 0.2f};

// Computes the base pose from a quaternion and the position of the base origin.
static void turned_base(const float* quaternion, const float* place, float* base) {
    static const float origin[3] = {0, 0, 0};
    float x[7] = {place[0], place[1], place[2], quaternion[0], quaternion[1], quaternion[2], quaternion[3]};
    Hand at_origin = {};
    at_origin.pivot = origin;
    base_pose(at_origin, x, base);
}

// State of `find_pregrasp` and `settle` between steps. The variables are base position and joints.
struct Opening {
    explicit Opening(const Problem& p)
        : variables(3 + p.hand.joints), start(variables), y(variables), at(variables), mean(variables),
          square(variables), gradient(variables), slope(variables), wanted(std::max(WAY * padded(p.coarse.count), p.fine.count)) {}
    int variables;
    Array<float> start, y, at, mean, square, gradient, slope;
    Array<float> wanted;  // wanted distance of every candidate, at every `TO_GO`
};

// Computes link poses and candidate distances on the path, where the share `to_go` to the grasp is left.
static void place_on_way(const Problem& p, const float* quaternion, float to_go, Opening& o, Scratch& s) {
    for (int i = 0; i < o.variables; i++) o.at[i] = to_go * o.y[i] + (1 - to_go) * o.start[i];
    float base[12];
    turned_base(quaternion, o.at, base);
    place_links(p.hand, base, o.at + 3, s.link);
    place_points(p.coarse, s.link, s.candidates.x, s.candidates.y, s.candidates.z);
    sample(p.object.grid, p.coarse.count, s.candidates);
}

// Adds the gradient of one point of the path: candidates nearer than wanted, obstacles, and self-collision.
static void add_way_slope(
    const Problem& p, const float* wanted, float to_go, float self_weight, bool spheres, Opening& o, Scratch& s) {
    Samples& at = s.candidates;
    bool any = false;
    for (int i = 0; i < p.coarse.count; i++) {
        float missing = (wanted[i] - at.phi[i]) * MILLIMETRES;
        any |= !(missing <= 0);
        at.a_phi[i] = missing <= 0 ? 0.f : -2.f * MILLIMETRES * missing / p.coarse.count;
        at.a_nx[i] = at.a_ny[i] = at.a_nz[i] = 0;
    }
    for (int i = 0; i < 6 * p.hand.links; i++) s.wrench[i] = 0;
    if (any) {
        sample_adjoint(p.object.grid, p.coarse.count, at);
        gather_wrenches(p.coarse, at, s.wrench);
    }
    float blocked = obstacle_depth(p, 1.f, s);
    if (self_weight > 0) {
        float deepest;
        if (spheres) blocked += self_collision(p.spheres, self_weight, s.link, s.sphere, s.wrench);
        blocked += solid_overlap(p, self_weight, &deepest, s);
    }
    if (!any && blocked == 0) return;
    for (int i = 0; i < o.variables; i++) o.slope[i] = 0;
    pull_back_joints(p.hand, s.link, s.wrench, o.slope + 3);
    for (int i = 0; i < 3; i++) o.slope[i] = s.wrench[i];
    for (int i = 0; i < o.variables; i++) o.gradient[i] += to_go * o.slope[i];
}

// Sets the gradient to that of the cost of travel from the grasp.
static void add_travel_slope(const Hand& hand, const Pregrasp& settings, Opening& o) {
    for (int i = 0; i < o.variables; i++) {
        float scale = i < 3 ? 1.f : hand.joint_scale[i - 3];
        float cost = i < 3 ? settings.base_cost : settings.joint_cost / (scale * scale);
        o.gradient[i] = 2 * cost * (o.y[i] - o.start[i]);
    }
}

// Takes an Adam step with a decaying rate. An entry of the gradient that is not finite counts as zero.
static void opening_step(const Hand& hand, const Pregrasp& settings, int count, Opening& o) {
    const float first = 1.f / (1.f - powf(BETA1, count)), second = 1.f / (1.f - powf(BETA2, count));
    const float fade = 1.f - 0.9f * count / settings.steps;
    for (int i = 0; i < o.variables; i++) {
        float g = std::isfinite(o.gradient[i]) ? o.gradient[i] : 0.f;
        o.mean[i] = BETA1 * o.mean[i] + (1 - BETA1) * g;
        o.square[i] = BETA2 * o.square[i] + (1 - BETA2) * g * g;
        float rate = i < 3 ? settings.base_rate : settings.joint_rate * hand.joint_scale[i - 3];
        o.y[i] -= fade * rate * (o.mean[i] * first) / (sqrtf(o.square[i] * second) + ADAM_EPSILON);
        if (i >= 3) o.y[i] = std::min(std::max(o.y[i], hand.lower[i - 3]), hand.upper[i - 3]);
    }
}

// Finds the pregrasp `out` (base position, joints) of a grasp x (base position, quaternion, joints). Returns the
// fraction of the wanted clearance that the path keeps: 1 if it keeps all.
template <class Go>
static float find_pregrasp(const Problem& p, const Pregrasp& settings, const float* x, float* out, Scratch& s, Go go) {
    const Hand& hand = p.hand;
    const int stride = padded(p.coarse.count);
    Opening o(p);
    for (int i = 0; i < o.variables; i++) o.start[i] = o.y[i] = i < 3 ? x[i] : x[4 + i];
    place_on_way(p, x + 3, 0.f, o, s);
    // If the grasp penetrates the object, the path may end at this depth.
    for (int k = 0; k < WAY; k++)
        for (int i = 0; i < p.coarse.count; i++)
            o.wanted[k * stride + i] = std::min(s.candidates.phi[i], 0.f) * (1 - TO_GO[k]) + TO_GO[k] * settings.clearance;
    for (int count = 1; count <= settings.steps && go(); count++) {
        add_travel_slope(hand, settings, o);
        for (int k = 0; k < WAY; k++) {
            place_on_way(p, x + 3, TO_GO[k], o, s);
            // Only the pregrasp gets the self-collision term, because the optimiser has applied it to the grasp.
            const float self_weight = k == 0 ? settings.self_collision : 0.f;
            add_way_slope(p, o.wanted + k * stride, TO_GO[k], self_weight, settings.spheres != 0, o, s);
        }
        opening_step(hand, settings, count, o);
    }
    float worst = -INFINITY;
    for (int k = 0; k < WAY; k++) {
        place_on_way(p, x + 3, TO_GO[k], o, s);
        for (int i = 0; i < p.coarse.count; i++) {
            float missing = o.wanted[k * stride + i] - s.candidates.phi[i];
            worst = missing <= worst ? worst : missing;
        }
    }
    for (int i = 0; i < o.variables; i++) out[i] = o.y[i];
    return 1.f - worst / settings.clearance;
}

// Adds the gradient of squared depths [mm²]: of candidates in the object, of the deepest object point in each solid, of
// solids in each other, and of the hand in obstacles. Also adds the gradient that keeps contacts.
static void add_sunk_slope(const Problem& p, float weight, float keep, Opening& o, Scratch& s) {
    Samples& at = s.candidates;
    for (int i = 0; i < 6 * p.hand.links; i++) s.wrench[i] = 0;
    bool any = false;
    for (int i = 0; i < p.fine.count; i++) {
        float depth = -at.phi[i] * MILLIMETRES, away = (at.phi[i] - o.wanted[i]) * MILLIMETRES;
        any |= !(depth <= 0) || away > 0;
        at.a_phi[i] = away > 0 ? 2.f * keep * MILLIMETRES * away : depth <= 0 ? 0.f : -2.f * weight * MILLIMETRES * depth;
        at.a_nx[i] = at.a_ny[i] = at.a_nz[i] = 0;
    }
    if (any) {
        sample_adjoint(p.object.grid, p.fine.count, at);
        gather_wrenches(p.fine, at, s.wrench);
    }
    for (int k = 0; k < p.solids.count; k++) {
        float slope[3], depth;
        const int feature = deepest_feature(p, k, &depth, slope, s);
        if (feature < 0) continue;
        const float* point = p.object.features + feature;
        const float pull = 2.f * weight * MILLIMETRES * MILLIMETRES * depth;
        push(s.wrench + 6 * p.solids.link[k], point[0], point[p.object.feature_stride], point[2 * p.object.feature_stride],
             pull * slope[0], pull * slope[1], pull * slope[2]);
    }
    float deepest;
    solid_overlap(p, weight, &deepest, s);
    obstacle_depth(p, weight, s);
    for (int i = 0; i < o.variables; i++) o.slope[i] = 0;
    pull_back_joints(p.hand, s.link, s.wrench, o.slope + 3);
    for (int i = 0; i < 3; i++) o.slope[i] = s.wrench[i];
    for (int i = 0; i < o.variables; i++) o.gradient[i] += o.slope[i];
}

// Finds a grasp `out` (base position, joints) that penetrates less, near a grasp x (base position, quaternion, joints).
template <class Go>
static void settle(const Problem& p, const Pregrasp& settings, const float* x, float* out, Scratch& s, Go go) {
    Opening o(p);
    for (int i = 0; i < o.variables; i++) o.start[i] = o.y[i] = i < 3 ? x[i] : x[4 + i];
    for (int count = 1; count <= settings.steps && go(); count++) {
        add_travel_slope(p.hand, settings, o);
        float base[12];
        turned_base(x + 3, o.y, base);
        place_links(p.hand, base, o.y + 3, s.link);
        place_points(p.fine, s.link, s.candidates.x, s.candidates.y, s.candidates.z);
        sample(p.object.grid, p.fine.count, s.candidates);
        for (int i = 0; count == 1 && i < p.fine.count; i++)
            o.wanted[i] = s.candidates.phi[i] < settings.clearance ? std::max(s.candidates.phi[i], 0.f) : INFINITY;
        place_solids(p, s);
        add_sunk_slope(p, settings.self_collision, settings.keep, o, s);
        opening_step(p.hand, settings, count, o);
    }
    for (int i = 0; i < o.variables; i++) out[i] = o.y[i];
}

// Finds the sharp points nearest to the solids of a hand at x (base position, quaternion, joints).
static void nearest_features(const Problem& p, const float* x, int32_t* pick, float* distance, float* gradient, Scratch& s) {
    float base[12];
    turned_base(x + 3, x, base);
    place_links(p.hand, base, x + 7, s.link);
    place_solids(p, s);
    nearest_features(p, pick, distance, gradient, s);
}

// Returns the greatest overlap depth of two solids of links that are not adjacent [m].
static float self_overlap(const Problem& p, const float* joints, Scratch& s) {
    const float standing[7] = {0, 0, 0, 1, 0, 0, 0};
    float base[12], deepest;
    turned_base(standing + 3, standing, base);
    place_links(p.hand, base, joints, s.link);
    solid_overlap(p, 0.f, &deepest, s);
    return deepest;
}

}  // namespace graspd
