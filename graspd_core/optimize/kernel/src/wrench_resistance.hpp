// Resistance of soft contacts against the worst disturbances (optimize/losses.py, docs/method.md):
//     v_ik = w_k,lin + w_k,ang × a_i,   h_k = Σ_i s_i max(0, μ √(|v|² - (n·v)²) - n·v),
//     loss = ¼ log mean_k (h_k / μ + 10⁻³)⁻⁴.
#pragma once
#include "terms.hpp"

namespace graspd {

constexpr float TANGENT_FLOOR = 1e-6f, SUPPORT_FLOOR = 1e-3f, SHARPNESS = 4.f;

// Copies arms, normals and activations of the nearest candidates. Lanes after the last candidate count as zero.
static int choose_contacts(const Problem& p, const Points& points, float delta, bool soft, Scratch& s) {
    Task& t = s.task;
    const Object& object = p.object;
    const Samples& at = s.candidates;
    int count = least(s.key, points.count, std::min(p.task_points, points.count), &s.cut_of_task, t.index);
    const float inverse = 1.f / object.length;
    for (int j = 0; j < padded(count); j++) {
        t.ax[j] = t.ay[j] = t.az[j] = t.nx[j] = t.ny[j] = t.nz[j] = t.known[j] = 0;
        t.cx[j] = t.cy[j] = t.cz[j] = 0;
        t.s[j] = INFINITY;
    }
    for (int j = 0; j < count; j++) {
        int i = t.index[j];
        t.ax[j] = (at.x[i] - object.center[0]) * inverse;
        t.ay[j] = (at.y[i] - object.center[1]) * inverse;
        t.az[j] = (at.z[i] - object.center[2]) * inverse;
        t.nx[j] = at.nx[i];
        t.ny[j] = at.ny[i];
        t.nz[j] = at.nz[i];
        t.s[j] = s.key[i];
        t.known[j] = 1;
        if (object.confidence) {
            float slope[3];
            t.known[j] = sample_scalar(object.grid, object.confidence, at, i, slope);
            t.cx[j] = slope[0];
            t.cy[j] = slope[1];
            t.cz[j] = slope[2];
        }
    }
    for (int j = 0; j < padded(count); j += LANES) {
        Floats key = load(t.s + j);
        Floats hard = key <= delta ? all(1.f) : Floats{};
        store(t.s + j, soft ? exponential(key * (-1.f / delta)) : hard);
    }
    return count;
}

// Computes v = w_lin + w_ang × a for one disturbance d and a vector of arms.
#define GRASPD_VELOCITY(d, ax, ay, az)                                                     \
    Floats vx = d[0] + d[4] * az - d[5] * ay, vy = d[1] + d[5] * ax - d[3] * az, \
           vz = d[2] + d[3] * ay - d[4] * ax

// Computes h of every disturbance, per lane, in t.support. Stores the values that the adjoint needs.
static void support(const Problem& p, int whole, Task& t) {
    for (int k = 0; k < p.directions * LANES; k++) t.support[k] = 0;
    for (int b = 0; b < whole; b += LANES) {
        Floats ax = load(t.ax + b), ay = load(t.ay + b), az = load(t.az + b);
        Floats nx = load(t.nx + b), ny = load(t.ny + b), nz = load(t.nz + b), s = load(t.s + b) * load(t.known + b);
        for (int k = 0; k < p.directions; k++) {
            const float* d = p.direction + 6 * k;
            GRASPD_VELOCITY(d, ax, ay, az);
            Floats normal_speed = nx * vx + ny * vy + nz * vz;
            Floats squared = vx * vx + vy * vy + vz * vz - normal_speed * normal_speed;
            Floats floored = squared < TANGENT_FLOOR ? all(TANGENT_FLOOR) : squared;
            Floats inverse = inverse_root(floored);
            Floats force = p.friction * floored * inverse - normal_speed;
            force = force < 0.f ? Floats{} : force;
            store(t.support + k * LANES, load(t.support + k * LANES) + s * force);
            int at = k * whole + b;
            store(t.normal_speed + at, normal_speed);
            store(t.inverse_speed + at, squared < TANGENT_FLOOR ? Floats{} : inverse);
            store(t.resisted + at, force);
        }
    }
}

// Returns the loss. Writes the derivative of the weighted loss in every h to t.slope.
static float soft_worst(const Problem& p, float weight, Task& t) {
    float top = -INFINITY, total = 0;
    for (int k = 0; k < p.directions; k++) {
        float resisted = sum(load(t.support + k * LANES)) / p.friction + SUPPORT_FLOOR;
        t.slope[k] = -1.f / (resisted * p.friction);
        t.support[k * LANES] = -SHARPNESS * logf(resisted);
        top = t.support[k * LANES] > top ? t.support[k * LANES] : top;
    }
    for (int k = 0; k < p.directions; k++) total += t.support[k * LANES] = expf(t.support[k * LANES] - top);
    for (int k = 0; k < p.directions; k++) t.slope[k] *= weight * t.support[k * LANES] / total;
    return (top + logf(total) - logf((float)p.directions)) / SHARPNESS;
}

// Computes the gradients in arms, normals and activations.
static void support_adjoint(const Problem& p, int whole, Task& t) {
    for (int b = 0; b < whole; b += LANES) {
        Floats ax = load(t.ax + b), ay = load(t.ay + b), az = load(t.az + b);
        Floats nx = load(t.nx + b), ny = load(t.ny + b), nz = load(t.nz + b);
        Floats gax = {}, gay = {}, gaz = {}, gnx = {}, gny = {}, gnz = {}, gs = {};
        for (int k = 0; k < p.directions; k++) {
            const float *d = p.direction + 6 * k, slope = t.slope[k];
            int at = k * whole + b;
            Floats force = load(t.resisted + at), normal_speed = load(t.normal_speed + at);
            gs += slope * force;
            Floats pushed = force > 0.f ? all(slope) : Floats{};
            Floats tangent = pushed * load(t.inverse_speed + at) * p.friction;
            Floats normal = -pushed - tangent * normal_speed;
            GRASPD_VELOCITY(d, ax, ay, az);
            gnx += normal * vx;
            gny += normal * vy;
            gnz += normal * vz;
            Floats gx = normal * nx + tangent * vx, gy = normal * ny + tangent * vy, gz = normal * nz + tangent * vz;
            gax += gy * d[5] - gz * d[4];
            gay += gz * d[3] - gx * d[5];
            gaz += gx * d[4] - gy * d[3];
        }
        Floats s = load(t.s + b) * load(t.known + b);
        store(t.gax + b, gax * s);
        store(t.gay + b, gay * s);
        store(t.gaz + b, gaz * s);
        store(t.gnx + b, gnx * s);
        store(t.gny + b, gny * s);
        store(t.gnz + b, gnz * s);
        store(t.gs + b, gs);
    }
}
#undef GRASPD_VELOCITY

// Returns the unweighted loss. Adds adjoints of distance and normal to the candidates, and of points to t.ga*.
static float wrench_resistance(
    const Problem& p, const Points& points, float radius, float delta, bool soft, float weight, Scratch& s) {
    Task& t = s.task;
    Samples& at = s.candidates;
    const int count = choose_contacts(p, points, delta, soft, s);
    support(p, padded(count), t);
    const float loss = soft_worst(p, weight, t), inverse = 1.f / p.object.length;
    support_adjoint(p, padded(count), t);
    for (int j = 0; j < count; j++) {
        int i = t.index[j];
        at.a_nx[i] = t.gnx[j];
        at.a_ny[i] = t.gny[j];
        at.a_nz[i] = t.gnz[j];
        float gap = at.phi[i] - radius, fall = soft ? -t.gs[j] * t.known[j] * t.s[j] / delta : 0.f;
        at.a_phi[i] += gap < 0 ? -fall : gap > 0 ? fall : 0.f;
        t.gax[j] = t.gax[j] * inverse + t.gs[j] * t.s[j] * t.cx[j];
        t.gay[j] = t.gay[j] * inverse + t.gs[j] * t.s[j] * t.cy[j];
        t.gaz[j] = t.gaz[j] * inverse + t.gs[j] * t.s[j] * t.cz[j];
    }
    t.count = count;
    return loss;
}

}  // namespace graspd
