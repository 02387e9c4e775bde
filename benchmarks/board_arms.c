/* The joints of armsight.sim.joints around the firmware's core, and a host that sends set points: one loop, so that ten
 * thousand arms take minutes. The arrays are those of a JointPlant; a test holds that both compute the same bits. */
#include <math.h>
#include <stddef.h>

#include "types.h"

#define SUBSTEPS 4
#define TICK 0.001
#define STOP_RAD 2.55
#define CYCLE_RAD 6.283185307179586
#define ZERO_COUNTS 32767.5
#define COUNTS_PER_RAD ((62258 - 3277) / 5.2)
#define STEP_COUNTS 4
#define SPEED_TICKS 8u /* over which a joint's speed is taken: less shows how the converter's noise shakes it */

typedef struct arm_loop {
    double *q, *qd, *link, *linkd, *qdd, *model, *between, *hand, *current_a, *broken, *stuck, *offset_a;
    int64_t *fault;
    uint64_t *noise;
    uint32_t *counts;
    int32_t *current_ma;
    uint8_t *blocked;
    void (*core_tick)(core_state *, const core_inputs *, core_outputs *);
    core_state *core;
    core_inputs *inputs;
    core_outputs *outputs;
    double fastest;   /* while it is enabled: of any joint, of its limit, */
    double apart_rad; /* from its reference */
    uint32_t supply_mv, ticks, sequence, unused;
    double way[SPEED_TICKS][JOINTS]; /* where the joints were of late */
} arm_loop;

uint32_t arm_run(arm_loop *arm, uint32_t ticks);
void cascade_around(arm_loop *arm, double share);
uint32_t arm_follow(arm_loop *arm, const double *points, uint32_t count, uint32_t period, uint32_t stop, double *trace);

static double normal(uint64_t *state)
{
    int64_t total = 0;
    uint64_t s = *state;
    for (int k = 0; k < 4; k++) {
        s ^= s << 13;
        s ^= s >> 7;
        s ^= s << 17;
        total += (int64_t)((s >> 40) & 0xFFFFu) - 32768;
    }
    *state = s;
    return (double)total / 37837.2;
}

static void sense(arm_loop *arm)
{
    const double *model = arm->model;
    for (uint32_t i = 0u; i < JOINTS; i++) {
        const double noise = normal(&arm->noise[i]);
        const double kept = arm->broken[i];
        const double size = arm->broken[JOINTS + i];
        double *memory = &arm->broken[2u * JOINTS + i];
        double true_counts = ZERO_COUNTS + COUNTS_PER_RAD * arm->link[i];
        switch (arm->fault[i]) {
        case 4: true_counts += size; break;
        case 5: true_counts = 2 * kept - true_counts; break;
        case 6: true_counts = kept; break;
        case 7: true_counts -= fmin(fmax(0.5 * (true_counts - kept), -size), size); break;
        case 8: *memory += size * TICK; true_counts += *memory; break;
        case 9: true_counts = kept + size * (true_counts - kept); break;
        case 10: *memory += (true_counts - *memory) / size; true_counts = *memory; break;
        default: break;
        }
        int64_t reading = (int64_t)floor((true_counts + model[8u * JOINTS + i] * noise) / STEP_COUNTS) * STEP_COUNTS;
        reading = arm->fault[i] == 1 ? 65535 : arm->fault[i] == 2 ? 0 : arm->fault[i] == 3 ? arm->counts[i] : reading;
        arm->counts[i] = (uint32_t)(reading < 0 ? 0 : reading > 65535 ? 65535 : reading);
        const double current_noise = normal(&arm->noise[i]);
        const double seen_a = model[10u * JOINTS + i] * arm->current_a[i] + arm->offset_a[i];
        arm->current_ma[i] = (int32_t)floor(1e3 * seen_a + model[9u * JOINTS + i] * current_noise + 0.5);
    }
}

static double sine(double cycles)
{
    cycles -= floor(cycles + 0.5);
    cycles = cycles > 0.25 ? 0.5 - cycles : cycles < -0.25 ? -0.5 - cycles : cycles;
    const double a = CYCLE_RAD * cycles, x = a * a;
    return a * (1 - x / 6 * (1 - x / 20 * (1 - x / 42 * (1 - x / 72 * (1 - x / 110 * (1 - x / 156))))));
}

static void step(arm_loop *arm)
{
    const double *model = arm->model, *between = arm->between;
    const core_outputs *out = arm->outputs;
    const int awake = out->drives_on != 0u || out->windings_shorted != 0u;
    const double h = TICK / SUBSTEPS;
    const double supply_v = arm->supply_mv * 1e-3;
    double before = 0.0;
    for (uint32_t i = 0u; i < JOINTS; i++) {
        const double own = model[2u * JOINTS + i], constant = model[JOINTS + i];
        const double duty = arm->stuck[i] == 0.0 ? (double)out->duty[i] : arm->stuck[i];
        const double conductance = awake ? constant / model[i] : 0.0;
        const double dry = model[4u * JOINTS + i] + (out->brakes_open == 0u ? model[11u * JOINTS + i] : 0.0);
        const double stiffness = between[i], half = 0.5 * model[6u * JOINTS + i];
        const double mass = stiffness == 0.0 ? own : own * (1 - between[2u * JOINTS + i]);
        const double inertia = mass + h * (model[3u * JOINTS + i] + conductance * constant);
        const double grip = h * dry / inertia;
        const double x = arm->link[i] * arm->link[i];
        const double cosine = 1 - x / 2 * (1 - x / 12 * (1 - x / 30 * (1 - x / 56 * (1 - x / 90))));
        const double load = arm->hand[i] - model[5u * JOINTS + i] * cosine - model[7u * JOINTS + i] * own * before;
        const double push = h * (conductance * duty * supply_v + (stiffness == 0.0 ? load : 0.0));
        const double start = arm->qd[i], drum = between[5u * JOINTS + i], per_rev = between[6u * JOINTS + i];
        const double cycles_per_rad = per_rev / CYCLE_RAD, phase = between[7u * JOINTS + i];
        for (int k = 0; k < SUBSTEPS; k++) {
            double torque = 0.0;
            if (stiffness > 0.0) {
                const double cycles = cycles_per_rad * arm->q[i] + phase;
                const double ratio = 1 + drum * per_rev * sine(cycles + 0.25);
                double twist = arm->q[i] + drum * sine(cycles) - arm->link[i];
                twist = twist > half ? twist - half : twist < -half ? twist + half : 0.0;
                const double stiff = stiffness * (1 + between[3u * JOINTS + i] * arm->link[i]) *
                                     (twist < 0.0 ? between[4u * JOINTS + i] : 1.0);
                const double damped = twist != 0.0 || half == 0.0
                                          ? between[JOINTS + i] * (ratio * arm->qd[i] - arm->linkd[i]) : 0.0;
                const double pull = stiff * twist + damped;
                torque = ratio * pull;
                arm->linkd[i] = arm->blocked[i] ? 0.0 : arm->linkd[i] + h * (pull + load) / (own - mass);
                arm->link[i] += h * arm->linkd[i];
                if (fabs(arm->link[i]) >= STOP_RAD) {
                    arm->link[i] = arm->link[i] > 0 ? STOP_RAD : -STOP_RAD;
                    arm->linkd[i] = 0.0;
                }
            }
            const double free = (mass * arm->qd[i] + push - h * torque) / inertia;
            arm->qd[i] = arm->blocked[i] || fabs(free) <= grip ? 0.0 : (free > 0 ? free - grip : free + grip);
            arm->q[i] += h * arm->qd[i];
            if (stiffness == 0.0 && fabs(arm->q[i]) >= STOP_RAD) {
                arm->q[i] = arm->q[i] > 0 ? STOP_RAD : -STOP_RAD;
                arm->qd[i] = 0.0;
            }
        }
        before = arm->qdd[i];
        arm->qdd[i] = (arm->qd[i] - start) / TICK;
        if (stiffness == 0.0) {
            const double led = arm->q[i] + drum * sine(cycles_per_rad * arm->q[i] + phase);
            arm->link[i] = fmin(fmax(arm->link[i], led - half), led + half);
        }
        arm->way[arm->ticks % SPEED_TICKS][i] = arm->link[i];
        arm->current_a[i] = awake ? (duty * supply_v - constant * arm->qd[i]) / model[i] : 0.0;
    }
}

/* Run so many ticks; returns the faults latched then. */
uint32_t arm_run(arm_loop *arm, uint32_t ticks)
{
    for (uint32_t tick = 0u; tick < ticks; tick++) {
        sense(arm);
        arm->inputs->tick = ++arm->ticks;
        arm->inputs->supply_mv = arm->supply_mv;
        for (uint32_t i = 0u; i < JOINTS; i++) {
            arm->inputs->counts[i] = arm->counts[i];
            arm->inputs->current_ma[i] = arm->current_ma[i];
        }
        arm->core_tick(arm->core, arm->inputs, arm->outputs);
        arm->inputs->command.kind = COMMAND_NONE;
        step(arm);
        if (arm->outputs->state == STATE_ENABLED) {
            for (uint32_t i = 0u; i < JOINTS; i++) {
                const double before = arm->way[(arm->ticks + 1u) % SPEED_TICKS][i];
                const double limit_rad_s = (double)arm->core->config.joint[i].speed_limit_rad_s;
                const double share = fabs(arm->link[i] - before) / (TICK * (SPEED_TICKS - 1u)) / limit_rad_s;
                arm->fastest = arm->ticks > SPEED_TICKS ? fmax(arm->fastest, share) : 0.0;
                arm->apart_rad = fmax(arm->apart_rad, fabs(arm->link[i] - (double)arm->outputs->reference_rad[i]));
            }
        }
    }
    return arm->outputs->faults;
}

/* Send count points (18 numbers each: positions, speeds, gravity duties), one every period ticks, until a fault where
 * stop is not 0. trace: count * period rows of 12 (link, reference) or NULL. Returns the ticks that passed. */
uint32_t arm_follow(arm_loop *arm, const double *points, uint32_t count, uint32_t period, uint32_t stop, double *trace)
{
    uint32_t passed = 0u;
    for (uint32_t k = 0u; k < count; k++, points += 3u * JOINTS) {
        move_command *move = &arm->inputs->command.move;
        for (uint32_t i = 0u; i < JOINTS; i++) {
            move->position_rad[i] = (float)points[i];
            move->speed_rad_s[i] = (float)points[JOINTS + i];
            move->gravity_duty[i] = (float)points[2u * JOINTS + i];
        }
        move->duration_ticks = period;
        arm->inputs->command.kind = COMMAND_MOVE;
        arm->inputs->command.sequence = ++arm->sequence;
        for (uint32_t tick = 0u; tick < period; tick++) {
            const uint32_t faults = arm_run(arm, 1u);
            passed++;
            for (uint32_t i = 0u; trace != NULL && i < JOINTS; i++) {
                trace[i] = arm->link[i];
                trace[JOINTS + i] = (double)arm->outputs->reference_rad[i];
            }
            trace = trace != NULL ? trace + 2u * JOINTS : NULL;
            if (stop != 0u && faults != 0u) {
                return passed;
            }
        }
    }
    return passed;
}

/* The law others use, for comparison: P of the position around PI of the speed, with the board's feed-forward, limits and
 * speed filter. The speed loop has a pair of poles at bandwidth and damping 1, the position loop share of it. */
static void (*watched_tick)(core_state *, const core_inputs *, core_outputs *);
static double cascade_share, integral_duty[JOINTS], last_duty[JOINTS];

static double clamped(double x, double low, double high) { return x < low ? low : x > high ? high : x; }

static void cascade_tick(core_state *core, const core_inputs *inputs, core_outputs *outputs)
{
    watched_tick(core, inputs, outputs);
    for (uint32_t i = 0u; i < JOINTS; i++) {
        const joint_config *config = &core->config.joint[i];
        const joint_gains *gains = &config->gains;
        if (outputs->drives_on == 0u) {
            integral_duty[i] = last_duty[i] = 0.0;
            continue;
        }
        const double own = (double)gains->kv_s_per_rad - (double)gains->kd_s_per_rad; /* the motor damps itself by it */
        const double inertia = (double)gains->ka_s2_per_rad;
        const double bandwidth_rad_s = 0.25 / (double)gains->derivative_filter_s; /* tuning.py's */
        const double p = 2.0 * bandwidth_rad_s * inertia - own;
        const double rate = (double)outputs->reference_rad_s[i];
        const double asked_rad_s = rate + cascade_share * bandwidth_rad_s *
                                              (double)(outputs->reference_rad[i] - outputs->angle_rad[i]);
        const double off_rad_s = asked_rad_s - (double)outputs->speed_rad_s[i];
        const double forward = own * rate + inertia * (double)core->joint[i].reference.acceleration_rad_s2 +
                               (double)gains->kf_duty * rate / (fabs(rate) + 0.005);
        const double asked = p * off_rad_s + integral_duty[i] + forward;
        const double slew = (double)config->duty_slew_per_s * TICK, most = (double)config->duty_limit;
        const double duty = clamped(clamped(asked, -most, most), last_duty[i] - slew, last_duty[i] + slew);
        integral_duty[i] += TICK * (inertia * bandwidth_rad_s * bandwidth_rad_s * off_rad_s +
                                    (double)gains->anti_windup_per_s * (duty - asked));
        last_duty[i] = duty;
        pid_state *pid = &core->joint[i].pid; /* the core watches its own law: let that follow what drives the joint */
        pid->integral_duty += (float)duty - pid->duty;
        pid->duty = (float)duty;
        outputs->duty[i] = (float)duty;
    }
}

/* Let the cascade drive the arm: the core keeps the references and what it reads. */
void cascade_around(arm_loop *arm, double share)
{
    watched_tick = arm->core_tick;
    cascade_share = share;
    arm->core_tick = cascade_tick;
}
