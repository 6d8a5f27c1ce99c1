// MuJoCo engine plugin: a geared brushed DC motor with encoder and brake, driven by the firmware.
//
// One actuator is one board. mj_step alone runs plant and servos: after each step the board
// runs with its new encoder count; in the next one the motor turns its duty into torque. All
// state, the device's included, lives in mjData's plugin_state. The motor's numbers are in the
// actuator's `user` array (enum motor), where a plant's parameters can be varied.
#include <math.h>
#include <mujoco/mujoco.h>
#include <string.h>

#include "board.h"

enum motor {
    COUNTS_PER_UNIT, // encoder counts per radian or metre of the joint
    GEAR,            // motor turns per joint turn
    TORQUE_CONSTANT, // Nm/A = V s/rad at the motor
    RESISTANCE,      // ohm
    SUPPLY,          // V
    BRAKE,           // Nm at the joint
    MOTOR_COUNT,
    HOLDING = MOTOR_COUNT, // of a stepper: Nm; 0 or missing: a brushed motor
    CYCLE,                 // encoder counts (steps) in a cycle of its currents
    STEPPER_COUNT
};

#define BRAKE_STIFFNESS 400.0 // times the brake's torque, per radian: it holds within 2.5 mrad
#define BRAKE_DAMPING 4.0     // times the brake's torque, s/rad
#define BRAKE_US 15000        // until it has engaged, or let go
#define REPORT_US 50          // from one chance to send a status to the next
#define CHOPPER_OHM 8.0

static int actuator_of(const mjModel *m, int instance) {
    for (int i = 0; i < m->nu; i++)
        if (m->actuator_plugin[i] == instance)
            return i;
    return -1;
}

static struct node *node_of(const mjModel *m, mjData *d, int instance) {
    return (struct node *)(d->plugin_state + m->plugin_stateadr[instance]);
}

static int state_size(const mjModel *m, int instance) {
    (void)m, (void)instance;
    return (int)((sizeof(struct node) + sizeof(mjtNum) - 1) / sizeof(mjtNum));
}

static bool on_fixed_tendon(const mjModel *m, int id) {
    int tendon = m->actuator_trnid[2 * id];
    return m->actuator_trntype[id] == mjTRN_TENDON &&
           m->wrap_type[m->tendon_adr[tendon]] == mjWRAP_JOINT;
}

// Of the axis: a joint's, or what a fixed tendon makes of several. Computed here, as the lengths that
// MuJoCo keeps are of the step's beginning.
static mjtNum along(const mjModel *m, int id, const mjtNum *joints, const int *places) {
    int target = m->actuator_trnid[2 * id];
    if (m->actuator_trntype[id] == mjTRN_JOINT)
        return joints[places[target]];
    mjtNum sum = 0;
    for (int i = 0; i < m->tendon_num[target]; i++) {
        int wrap = m->tendon_adr[target] + i;
        sum += m->wrap_prm[wrap] * joints[places[m->wrap_objid[wrap]]];
    }
    return sum;
}

static int check(const mjModel *m, mjData *d, int instance) {
    (void)d;
    int id = actuator_of(m, instance);
    if (id < 0 || !(m->actuator_trntype[id] == mjTRN_JOINT || on_fixed_tendon(m, id))) {
        mju_warning("headway.servo: the plugin drives an actuator on a joint or a fixed tendon");
        return -1;
    }
    if (m->nuser_actuator < MOTOR_COUNT) {
        mju_warning("headway.servo: the actuator's user array needs 6 numbers: counts per unit, "
                    "gear, torque constant, resistance, supply, brake");
        return -1;
    }
    return 0;
}

static void reset(const mjModel *m, mjtNum *plugin_state, void *plugin_data, int instance) {
    (void)plugin_data;
    struct node *node = (struct node *)plugin_state;
    memset(node, 0, sizeof *node);
    node->board.brake = true;
    node->board.brake_us = -BRAKE_US;
    int id = actuator_of(m, instance);
    node->board.feed_V = node->board.supply_V = m->actuator_user[id * m->nuser_actuator + SUPPLY];
}

// A stiff spring to where the brake engaged, as strong as the brake is. It takes its time, both ways.
static mjtNum brake_force(struct board *board, mjtNum strength, mjtNum position, mjtNum velocity) {
    bool settled = board->true_us - board->brake_us >= BRAKE_US;
    if (settled ? !board->brake : board->brake) {
        board->brake_anchored = false;
        return 0;
    }
    if (!board->brake_anchored) {
        board->brake_anchor = position;
        board->brake_anchored = true;
    }
    mjtNum force =
        -strength * (BRAKE_STIFFNESS * (position - board->brake_anchor) + BRAKE_DAMPING * velocity);
    return mju_clip(force, -strength, strength);
}

static bool is_stepper(const mjModel *m, const mjtNum *motor) {
    return m->nuser_actuator >= STEPPER_COUNT && motor[HOLDING] > 0;
}

// A sine of how far the rotor is from where its currents point (P. Acarnley, Stepping Motors, 4th edition,
// 2002, section 2.2): beyond half a cycle it is drawn to another tooth, and steps are lost.
static mjtNum stepper_force(const struct board *board, const mjtNum *motor, mjtNum position) {
    int32_t steps = board_steps(board, board_count_us(board));
    mjtNum count = position * motor[COUNTS_PER_UNIT], whole = floor(count);
    int32_t rotor = (int32_t)(uint32_t)(uint64_t)(int64_t)mju_clip(whole, -9e15, 9e15);
    uint32_t currents = (uint32_t)steps + (uint32_t)board->encoder_offset;
    mjtNum ahead = (int32_t)(currents - (uint32_t)rotor) - (count - whole);
    return motor[HOLDING] * sin(2 * mjPI * ahead / motor[CYCLE]);
}

static void compute(const mjModel *m, mjData *d, int instance, int capability) {
    (void)capability;
    int id = actuator_of(m, instance);
    const mjtNum *motor = m->actuator_user + id * m->nuser_actuator;
    struct board *board = &node_of(m, d, instance)->board;
    mjtNum position = along(m, id, d->qpos, m->jnt_qposadr);
    mjtNum velocity = along(m, id, d->qvel, m->jnt_dofadr);
    mjtNum force = brake_force(board, motor[BRAKE], position, velocity);
    board->current_A = 0;
    if (board->power && is_stepper(m, motor)) {
        mjtNum constant = motor[GEAR] * motor[TORQUE_CONSTANT]; // its windings damp
        force += stepper_force(board, motor, position) -
                 constant * constant / motor[RESISTANCE] * velocity;
    } else if (board->power) {
        mjtNum constant = motor[GEAR] * motor[TORQUE_CONSTANT];
        mjtNum voltage = board->duty_q15 / 32768.0 * board->supply_V;
        board->current_A = (voltage - constant * velocity) / motor[RESISTANCE];
        force += constant * board->current_A;
    }
    d->actuator_force[id] = force;
}

// The bridge's voltage: the supply's own or, with a capacitor behind a diode, what the motor has
// pumped into it beyond that.
static void charge(struct board *board, mjtNum dt) {
    mjtNum volts = board->supply_V;
    if (board->capacitance_F <= 0 || volts <= board->feed_V) {
        board->supply_V = board->feed_V;
        if (board->capacitance_F <= 0)
            return;
        volts = board->supply_V;
    }
    mjtNum drawn_A = board->duty_q15 / 32768.0 * board->current_A;
    if (board->chopper)
        drawn_A += volts / CHOPPER_OHM;
    volts -= drawn_A * dt / board->capacitance_F;
    board->supply_V = mju_max(volts, board->feed_V);
}

static void advance(const mjModel *m, mjData *d, int instance) {
    int id = actuator_of(m, instance);
    const mjtNum *motor = m->actuator_user + id * m->nuser_actuator;
    struct node *node = node_of(m, d, instance);
    mjtNum count = floor(along(m, id, d->qpos, m->jnt_qposadr) * motor[COUNTS_PER_UNIT] + 0.5);
    // Modulo 2^32, as an encoder's counter has it. Up to 2^53 counts can be told apart.
    count = mju_clip(count, -9e15, 9e15);
    board_set_encoder(&node->board, (int32_t)(uint32_t)(uint64_t)(int64_t)count);
    charge(&node->board, m->opt.timestep);
    int64_t end_us = node->board.true_us + (int64_t)floor(m->opt.timestep * 1e6 + 0.5);
    while (node->board.true_us + REPORT_US < end_us) {
        board_advance(&node->board, node->board.true_us + REPORT_US);
        if (!node->board.hung)
            device_report(&node->device, &node->board);
    }
    board_advance(&node->board, end_us);
    node_run(node);
}

mjPLUGIN_LIB_INIT(headway_servo) {
    mjpPlugin plugin;
    mjp_defaultPlugin(&plugin);
    plugin.name = "headway.servo";
    plugin.capabilityflags |= mjPLUGIN_ACTUATOR;
    plugin.nstate = state_size;
    plugin.init = check;
    plugin.reset = reset;
    plugin.compute = compute;
    plugin.advance = advance;
    mjp_registerPlugin(&plugin);
}
