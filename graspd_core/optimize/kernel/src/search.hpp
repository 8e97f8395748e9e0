// Steps of one start: coarse to fine, by projected Adam (optimize/closed_form/closed_form.py).
#pragma once
#include "objective.hpp"

namespace graspd {

constexpr float BETA1 = 0.9f, BETA2 = 0.98f, ADAM_EPSILON = 1e-8f, FINAL_RATE = 0.05f;

// Takes one Adam step (Kingma & Ba 2015) with a rate for every kind of variable. Joints are clamped to their limits.
static void adam(const Hand& hand, const Schedule& schedule, float rate, int count, const float* gradient, float* x,
                 float* mean, float* square) {
    const float first = 1.f / (1.f - powf(BETA1, count)), second = 1.f / (1.f - powf(BETA2, count));
    for (int i = 0; i < 7 + hand.joints; i++) {
        mean[i] = BETA1 * mean[i] + (1 - BETA1) * gradient[i];
        square[i] = BETA2 * square[i] + (1 - BETA2) * gradient[i] * gradient[i];
        float of_kind = i < 3   ? schedule.translation_rate
                        : i < 7 ? schedule.rotation_rate
                                : schedule.joint_rate * hand.joint_scale[i - 7];
        x[i] -= rate * of_kind * (mean[i] * first) / (sqrtf(square[i] * second) + ADAM_EPSILON);
    }
    float inverse = 1.f / sqrtf(x[3] * x[3] + x[4] * x[4] + x[5] * x[5] + x[6] * x[6]);
    for (int i = 3; i < 7; i++) x[i] *= inverse;
    for (int j = 0; j < hand.joints; j++) x[7 + j] = std::min(std::max(x[7 + j], hand.lower[j]), hand.upper[j]);
}

// Runs the steps [from, to) of one row. Before each step, `go` returns false to stop.
template <class Go>
static void run_steps(const Problem& p, const Schedule& schedule, const State& state, int row, int from, int to,
                      float* gradient, Scratch& s, Go go) {
    const int variables = 7 + p.hand.joints;
    const int steps = schedule.explore_steps + schedule.refine_steps + schedule.polish_steps;
    float *x = state.x + row * variables, *mean = state.mean + row * variables, *square = state.square + row * variables;
    for (int k = from; k < to && go(); k++) {
        float remaining = std::max(0.f, 1.f - (float)k / std::max(schedule.explore_steps, 1));
        bool polish = k >= schedule.explore_steps + schedule.refine_steps;
        Look look;
        look.radius = state.radius[row] * remaining;
        look.soft = schedule.soft != 0;
        look.delta = look.soft ? schedule.delta_end * powf(schedule.delta_start / schedule.delta_end, remaining)
                               : schedule.delta_end;
        look.fine = k >= steps - std::min(schedule.fine_steps, schedule.polish_steps);
        look.sharp = polish;
        float loss = evaluate(p, look.sharp ? schedule.polish_weights : schedule.weights, x, look, gradient, s);
        bool finite = std::isfinite(loss);
        for (int i = 0; i < variables; i++) finite = finite && std::isfinite(gradient[i]);
        if (!finite) {  // A start without finite loss and gradient gets a zero gradient.
            loss = INFINITY;
            for (int i = 0; i < variables; i++) gradient[i] = 0;
        }
        // Only the last stage is scored, so that an iterate on a padded surface never becomes the best.
        bool scored = look.fine || (schedule.fine_steps == 0 && polish) || (schedule.polish_steps == 0 && remaining == 0);
        if (scored && loss < state.best_loss[row]) {
            state.best_loss[row] = loss;
            memcpy(state.best_x + row * variables, x, sizeof(float) * variables);
        }
        float rate = FINAL_RATE + (1 - FINAL_RATE) * 0.5f * (1 + cosf((float)M_PI * k / steps));
        adam(p.hand, schedule, rate, k + 1, gradient, x, mean, square);
        state.loss[row] = loss;
    }
}

}  // namespace graspd
