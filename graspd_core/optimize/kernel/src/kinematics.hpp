// Forward kinematics, and gradients of the pose from forces on links (docs/method.md, hands/kinematics.py).
#pragma once
#include "scratch.hpp"

namespace graspd {

// Multiplies two 3x4 matrices, both with an implied last row 0 0 0 1.
INLINE void compose(const float* a, const float* b, float* out) {
    for (int r = 0; r < 3; r++)
        for (int c = 0; c < 4; c++)
            out[4 * r + c] =
                a[4 * r] * b[c] + a[4 * r + 1] * b[4 + c] + a[4 * r + 2] * b[8 + c] + (c == 3 ? a[4 * r + 3] : 0.f);
}

// Computes the base pose. The pivot is at x[0:3]. x[3:7] is a quaternion of any length.
static void base_pose(const Hand& hand, const float* x, float* base) {
    float scale = 1.f / sqrtf(x[3] * x[3] + x[4] * x[4] + x[5] * x[5] + x[6] * x[6]);
    float w = x[3] * scale, i = x[4] * scale, j = x[5] * scale, k = x[6] * scale;
    float r[9] = {1 - 2 * (j * j + k * k), 2 * (i * j - w * k),     2 * (i * k + w * j),
                  2 * (i * j + w * k),     1 - 2 * (i * i + k * k), 2 * (j * k - w * i),
                  2 * (i * k - w * j),     2 * (j * k + w * i),     1 - 2 * (i * i + j * j)};
    const float* pivot = hand.pivot;
    for (int row = 0; row < 3; row++) {
        for (int c = 0; c < 3; c++) base[4 * row + c] = r[3 * row + c];
        base[4 * row + 3] =
            x[row] - (r[3 * row] * pivot[0] + r[3 * row + 1] * pivot[1] + r[3 * row + 2] * pivot[2]);
    }
}

// Computes T_object_link of every link.
static void place_links(const Hand& hand, const float* base, const float* joints, float* link) {
    for (int l = 0; l < hand.links; l++) {
        const float *constant = hand.constant + 12 * l, *sine = hand.sine + 12 * l, *cosine = hand.cosine + 12 * l;
        float local[12];
        if (hand.kind[l] == FIXED) {
            memcpy(local, constant, sizeof local);
        } else {
            float v = joints[hand.joint[l]] * hand.multiplier[l] + hand.shift[l];
            if (hand.kind[l] == REVOLUTE) {
                float s = sinf(v), c = cosf(v);
                for (int i = 0; i < 12; i++) local[i] = constant[i] + s * sine[i] + c * cosine[i];
            } else {
                for (int i = 0; i < 12; i++) local[i] = constant[i] + v * hand.slide[12 * l + i];
            }
        }
        compose(l == 0 ? base : link + 12 * hand.parent[l], local, link + 12 * l);
    }
}

// Transforms link-frame points to the object frame. Lanes after the last point get a point far away.
static void place_points(const Points& points, const float* link, float* x, float* y, float* z) {
    const float *px = points.xyz, *py = px + points.stride, *pz = py + points.stride;
    for (int run = 0; run < points.runs; run++) {
        const float* t = link + 12 * points.run_link[run];
        // A vector may reach past the end of its run. The next run overwrites these lanes.
        for (int i = points.run_start[run]; i < points.run_start[run + 1]; i += LANES) {
            Floats a = load_unaligned(px + i), b = load_unaligned(py + i), c = load_unaligned(pz + i);
            store_unaligned(x + i, t[0] * a + t[1] * b + t[2] * c + t[3]);
            store_unaligned(y + i, t[4] * a + t[5] * b + t[6] * c + t[7]);
            store_unaligned(z + i, t[8] * a + t[9] * b + t[10] * c + t[11]);
        }
    }
    for (int i = points.count; i < padded(points.count); i++) x[i] = y[i] = z[i] = 1e3f;
}

// Adds a force at a point of the object frame to a link's wrench about the origin.
INLINE void push(float* wrench, float x, float y, float z, float fx, float fy, float fz) {
    wrench[0] += fx;
    wrench[1] += fy;
    wrench[2] += fz;
    wrench[3] += y * fz - z * fy;
    wrench[4] += z * fx - x * fz;
    wrench[5] += x * fy - y * fx;
}

// Adds the forces on points to the wrenches of their links.
static void gather_wrenches(const Points& points, const Samples& at, float* wrench) {
    for (int run = 0; run < points.runs; run++) {
        float total[6] = {0};
        for (int i = points.run_start[run]; i < points.run_start[run + 1]; i++)
            push(total, at.x[i], at.y[i], at.z[i], at.gx[i], at.gy[i], at.gz[i]);
        for (int k = 0; k < 6; k++) wrench[6 * points.run_link[run] + k] += total[k];
    }
}

// Adds joint gradients from the wrenches on links, tips first. Then the base's wrench is the wrench on the whole hand.
static void pull_back_joints(const Hand& hand, const float* link, float* wrench, float* joints) {
    for (int l = hand.links - 1; l >= 0; l--) {
        const float* f = wrench + 6 * l;
        if (hand.kind[l] != FIXED) {
            const float *t = link + 12 * l, *a = hand.axis + 3 * l;
            float axis[3];
            for (int r = 0; r < 3; r++) axis[r] = t[4 * r] * a[0] + t[4 * r + 1] * a[1] + t[4 * r + 2] * a[2];
            float along;
            if (hand.kind[l] == REVOLUTE) {
                float ox = t[3], oy = t[7], oz = t[11];
                along = axis[0] * (f[3] - (oy * f[2] - oz * f[1])) + axis[1] * (f[4] - (oz * f[0] - ox * f[2])) +
                        axis[2] * (f[5] - (ox * f[1] - oy * f[0]));
            } else {
                along = axis[0] * f[0] + axis[1] * f[1] + axis[2] * f[2];
            }
            joints[hand.joint[l]] += along * hand.multiplier[l];
        }
        if (l > 0)
            for (int k = 0; k < 6; k++) wrench[6 * hand.parent[l] + k] += f[k];
    }
}

// Computes the gradient in pivot position and quaternion (of any length) from the wrench on the whole hand.
static void pull_back_base(const float* x, const float* f, float* gradient) {
    float inverse = 1.f / sqrtf(x[3] * x[3] + x[4] * x[4] + x[5] * x[5] + x[6] * x[6]);
    float w = x[3] * inverse, i = x[4] * inverse, j = x[5] * inverse, k = x[6] * inverse;
    float mx = f[3] - (x[1] * f[2] - x[2] * f[1]), my = f[4] - (x[2] * f[0] - x[0] * f[2]),
          mz = f[5] - (x[0] * f[1] - x[1] * f[0]);
    for (int r = 0; r < 3; r++) gradient[r] = f[r];
    gradient[3] = -2 * inverse * (i * mx + j * my + k * mz);
    gradient[4] = 2 * inverse * (w * mx - (j * mz - k * my));
    gradient[5] = 2 * inverse * (w * my - (k * mx - i * mz));
    gradient[6] = 2 * inverse * (w * mz - (i * my - j * mx));
}

}  // namespace graspd
