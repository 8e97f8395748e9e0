// Interpolates signed distance and outward normal from a grid, with adjoints (mesh/sdf.py, `sample_sdf`).
//
// With b the point clamped to the grid, φ and g the interpolated channels there, r = max(φ, 1 mm), o = x - b:
//     f = o + r g,   distance = φ + |f| - r |g|,   normal = f / |f|.
#pragma once
#include "scratch.hpp"

namespace graspd {

constexpr float LEAST_REACH = 1e-3f, TINY = 1e-24f;
// Channels (distance and normal) of a point far from everything.
constexpr float FAR[4] = {1e3f, 1, 0, 0};

// Returns u - b, where b is the value of [0, most] nearest to u. Exactly zero inside, where a fused u - b may differ.
INLINE Floats beyond(Floats u, Floats b, float most) { return (u >= 0.f) & (u <= most) ? Floats{} : u - b; }

// Finds for each point its cell, its position in the cell, and its offset from the grid.
static void find_cells(const Grid& grid, int count, Samples& at) {
    const int row = 4 * grid.nz, plane = row * grid.ny;
    const float mx = grid.nx - 1, my = grid.ny - 1, mz = grid.nz - 1, inverse = 1.f / grid.spacing;
    for (int i = 0; i < count; i += LANES) {
        Floats ux = (load(at.x + i) - grid.origin[0]) * inverse, uy = (load(at.y + i) - grid.origin[1]) * inverse,
               uz = (load(at.z + i) - grid.origin[2]) * inverse;
        // A NaN point gets the first node, so that no read leaves the grid. The offset of the point keeps the NaN.
        Floats bx = lesser(greater(ux, all(0)), all(mx)), by = lesser(greater(uy, all(0)), all(my)),
               bz = lesser(greater(uz, all(0)), all(mz));
        store(at.ox + i, beyond(ux, bx, mx) * grid.spacing);
        store(at.oy + i, beyond(uy, by, my) * grid.spacing);
        store(at.oz + i, beyond(uz, bz, mz) * grid.spacing);
        Ints kx = __builtin_convertvector(lesser(bx, all(mx - 1)), Ints),
             ky = __builtin_convertvector(lesser(by, all(my - 1)), Ints),
             kz = __builtin_convertvector(lesser(bz, all(mz - 1)), Ints);
        store(at.fx + i, bx - __builtin_convertvector(kx, Floats));
        store(at.fy + i, by - __builtin_convertvector(ky, Floats));
        store(at.fz + i, bz - __builtin_convertvector(kz, Floats));
        *(Ints*)(at.cell + i) = kx * plane + ky * row + kz * 4;
    }
}

// Interpolates the four channels and their slopes at each point: first y and x, for two neighbours in z at once.
static void interpolate(const Grid& grid, int count, Samples& at) {
    const int row = 4 * grid.nz, plane = row * grid.ny;
    for (int i = 0; i < count; i++) {
        const float* node = grid.field + at.cell[i];
        Eight a = *(const EightUnaligned*)node, b = *(const EightUnaligned*)(node + row);
        Eight c = *(const EightUnaligned*)(node + plane), d = *(const EightUnaligned*)(node + plane + row);
        float fx = at.fx[i], fy = at.fy[i], fz = at.fz[i];
        Eight near_slope = b - a, far_slope = d - c;
        Eight near = a + fy * near_slope, along_x = c + fy * far_slope - near;
        Eight value = near + fx * along_x, along_y = near_slope + fx * (far_slope - near_slope);
        auto low = [](Eight v) { return __builtin_shufflevector(v, v, 0, 1, 2, 3); };
        auto high = [](Eight v) { return __builtin_shufflevector(v, v, 4, 5, 6, 7); };
        Four along_z = high(value) - low(value), channels = low(value) + fz * along_z;
        float* slope = at.slopes + 12 * i;
        *(Four*)slope = low(along_x) + fz * (high(along_x) - low(along_x));
        *(Four*)(slope + 4) = low(along_y) + fz * (high(along_y) - low(along_y));
        *(Four*)(slope + 8) = along_z;
        for (int c = 0; c < 4; c++) at.channel[c][i] = channels[c];
    }
}

// Computes distance and unit normal at (at.x, at.y, at.z). Lanes after the last point are far from everything.
static void sample(const Grid& grid, int count, Samples& at) {
    const int whole = padded(count);
    find_cells(grid, whole, at);
    interpolate(grid, count, at);
    for (int i = count; i < whole; i++)
        for (int c = 0; c < 4; c++) at.channel[c][i] = FAR[c];
    for (int i = 0; i < whole; i += LANES) {
        Floats phi = load(at.channel[0] + i), gx = load(at.channel[1] + i), gy = load(at.channel[2] + i),
               gz = load(at.channel[3] + i);
        Floats reach = greater(phi, all(LEAST_REACH));
        Floats x = load(at.ox + i) + reach * gx, y = load(at.oy + i) + reach * gy, z = load(at.oz + i) + reach * gz;
        Floats squared = x * x + y * y + z * z;
        Floats inverse = inverse_root(squared > TINY ? squared : all(TINY));
        store(at.phi + i, phi + squared * inverse - reach * root(gx * gx + gy * gy + gz * gz));
        store(at.nx + i, x * inverse);
        store(at.ny + i, y * inverse);
        store(at.nz + i, z * inverse);
    }
}

// Computes gradients in the points from the adjoints of distances and normals. Points after `count` get zero.
static void sample_adjoint(const Grid& grid, int count, Samples& at) {
    const float inverse = 1.f / grid.spacing;
    alignas(Floats) float channel[4][LANES], offset[3][LANES];
    for (int i = 0; i < count; i += LANES) {
        Floats a = load(at.a_phi + i), ax = load(at.a_nx + i), ay = load(at.a_ny + i), az = load(at.a_nz + i);
        unsigned some = bits((a != 0.f) | (ax != 0.f) | (ay != 0.f) | (az != 0.f));
        store(at.gx + i, Floats{});
        store(at.gy + i, Floats{});
        store(at.gz + i, Floats{});
        if (count - i < LANES) some &= (1u << (count - i)) - 1;
        if (!some) continue;
        Floats phi = load(at.channel[0] + i), g0 = load(at.channel[1] + i), g1 = load(at.channel[2] + i),
               g2 = load(at.channel[3] + i), nx = load(at.nx + i), ny = load(at.ny + i), nz = load(at.nz + i);
        Floats reach = greater(phi, all(LEAST_REACH));
        Floats x = load(at.ox + i) + reach * g0, y = load(at.oy + i) + reach * g1, z = load(at.oz + i) + reach * g2;
        Floats shrink = inverse_root(x * x + y * y + z * z + TINY), norm = root(g0 * g0 + g1 * g1 + g2 * g2);
        Floats along = nx * ax + ny * ay + nz * az;
        Floats sx = a * nx + (ax - nx * along) * shrink, sy = a * ny + (ay - ny * along) * shrink,
               sz = a * nz + (az - nz * along) * shrink;
        Floats a_reach = sx * g0 + sy * g1 + sz * g2 - a * norm, unit = a * reach / (norm + TINY);
        store(channel[0], a + (phi > LEAST_REACH ? a_reach : Floats{}));
        store(channel[1], reach * sx - unit * g0);
        store(channel[2], reach * sy - unit * g1);
        store(channel[3], reach * sz - unit * g2);
        store(offset[0], sx);
        store(offset[1], sy);
        store(offset[2], sz);
        for (; some; some &= some - 1) {
            const int lane = __builtin_ctz(some), point = i + lane;
            const float* slope = at.slopes + 12 * point;
            const Four c = {channel[0][lane], channel[1][lane], channel[2][lane], channel[3][lane]};
            // Beyond the grid along an axis, only the offset depends on the point. Inside, only the channels do.
            at.gx[point] = at.ox[point] != 0 ? offset[0][lane] : sum_four(c * *(const Four*)slope) * inverse;
            at.gy[point] = at.oy[point] != 0 ? offset[1][lane] : sum_four(c * *(const Four*)(slope + 4)) * inverse;
            at.gz[point] = at.oz[point] != 0 ? offset[2][lane] : sum_four(c * *(const Four*)(slope + 8)) * inverse;
        }
    }
}

// Returns the trilinear confidence at a point after `find_cells`, and its gradient. It is constant beyond the grid.
INLINE float sample_scalar(const Grid& grid, const float* values, const Samples& at, int i, float* gradient) {
    const int row = grid.nz, plane = row * grid.ny;
    const float* v = values + at.cell[i] / 4;
    float fx = at.fx[i], fy = at.fy[i], fz = at.fz[i];
    float a0 = v[0], a1 = v[1], b0 = v[row], b1 = v[row + 1];
    float c0 = v[plane], c1 = v[plane + 1], d0 = v[plane + row], d1 = v[plane + row + 1];
    auto mix = [](float p, float q, float f) { return p + f * (q - p); };
    float a = mix(a0, a1, fz), b = mix(b0, b1, fz), c = mix(c0, c1, fz), d = mix(d0, d1, fz);
    float near = mix(a, b, fy), far = mix(c, d, fy);
    float along_z = mix(mix(a1 - a0, b1 - b0, fy), mix(c1 - c0, d1 - d0, fy), fx);
    gradient[0] = at.ox[i] != 0 ? 0.f : (far - near) / grid.spacing;
    gradient[1] = at.oy[i] != 0 ? 0.f : mix(b - a, d - c, fx) / grid.spacing;
    gradient[2] = at.oz[i] != 0 ? 0.f : along_z / grid.spacing;
    return mix(near, far, fx);
}

}  // namespace graspd
