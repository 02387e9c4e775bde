/* Every record of the core: what a tick takes, what it gives, what it remembers and how it is set up.
 *
 * Angles are radians at the joint, duties are fractions of full drive (-1 to 1), counts are 16-bit fractions of the
 * potentiometer's supply (a 12-bit converter's reading is shifted left by four). Every record is built of fields of
 * two or four bytes without a hole, so that it reads the same everywhere and can be stored and checked as bytes.
 * Integers where a board measures, floats where the law computes: what comes from a board can never be NaN.
 */
#ifndef ARMSIGHT_TYPES_H
#define ARMSIGHT_TYPES_H

#include <stdint.h>

#define JOINTS 6u
#define POT_NODES 9u
#define TICKS_PER_S 1000u
#define TICK_S 0.001f
#define NO_JOINT 255u
#define WATCH_TICKS 3u /* each joint is watched every third tick, a third of them in each: so no tick is long */

/* X(name, code, reaction, text): the faults. A fault latches; docs/reference/firmware.md says when each comes. */
#define FAULT_LIST(X)                                                                                 \
    X(POT_OPEN, 1, JOINT, "potentiometer open: the reading is above its band")                        \
    X(POT_SHORT, 2, JOINT, "potentiometer short: the reading is below its band")                      \
    X(POT_FROZEN, 3, JOINT, "potentiometer frozen: the reading stands still while the motor rotates") \
    X(POT_JUMP, 4, JOINT, "potentiometer jump: the reading moved faster than the joint can")          \
    X(POT_INVERTED, 5, JOINT, "inverted: the reading moves against the motor")                        \
    X(FOLLOWING, 6, YIELD, "following error: the joint is too far from its reference")                \
    X(STALL, 7, YIELD, "stall: the motor is driven hard and the joint does not rotate")               \
    X(HOST_SILENT, 8, CHOSEN, "host silent: no motion command within the time set")                   \
    X(SUPPLY_LOW, 9, RELEASE, "supply too low")                                                       \
    X(SUPPLY_HIGH, 10, RELEASE, "supply too high")                                                    \
    X(TICK_MISSED, 11, HOLD, "tick missed: the control loop lost time")                               \
    X(TICK_OVERRUN, 12, HOLD, "tick overrun: the control loop took longer than its period")           \
    X(WATCHDOG, 13, RELEASE, "restarted by the watchdog")                                             \
    X(CONFIG, 14, RELEASE, "no valid configuration: factory values are in use")                       \
    X(POT_SLIP, 15, JOINT, "potentiometer slips: the reading stays behind the motor")                 \
    X(POT_DRIFT, 16, JOINT, "potentiometer drifts: the reading moves by itself")                      \
    X(POT_SCALE, 17, JOINT, "potentiometer scale: the reading moves too far or not far enough")       \
    X(POT_LAG, 18, JOINT, "potentiometer lags: the reading follows the motor late")                   \
    X(OVERLOAD, 19, YIELD, "overload: the duty is at its limit and the joint does not follow")        \
    X(PUSHED, 20, YIELD, "pushed: something moves the joint against its motor")                       \
    X(OVERSPEED, 21, HOLD, "overspeed: the joint is faster than its limit")                           \
    X(OSCILLATION, 22, HOLD, "oscillation: the joint swings about its reference; the stored gains are in use again") \
    X(CURRENT_SENSOR, 23, HOLD,                                                                                    \
      "current: its sensor shows another one than the voltage must drive, or a lead is broken")                       \
    X(OVERCURRENT, 24, JOINT, "overcurrent: the motor current stays beyond twice its limit")          \
    X(ARITHMETIC, 25, RELEASE, "arithmetic: a duty was no number")                                    \
    X(MEMORY, 26, RELEASE, "memory: the configuration in use has changed by itself")                  \
    X(TICKS_LOST, 27, RELEASE, "ticks lost: the control loop loses time again and again")             \
    X(TAKEN_OVER, 28, HOLD, "taken over: another host said hello while the arm was driven")           \
    X(CRASH, 29, RELEASE, "restarted after a crash of the firmware")                                      \
    X(ENCODER, 30, JOINT, "encoder: no sound reading: its wires, or a magnet too weak or too strong") \
    X(BRIDGE, 31, SLEEP, "bridge: it drives its motor by itself; all drives sleep")                        \
    X(MOTOR, 32, HOLD, "motor: weak, or a winding shorted: it moves otherwise than its voltage and current say")

/* X(name, code, text): the states. */
#define STATE_LIST(X)                                                     \
    X(DISABLED, 0, "disabled: drives off")                                \
    X(ENABLED, 1, "enabled: follows the host")                            \
    X(STOPPING, 2, "stopping: a fault slows the arm down to rest")        \
    X(HOLDING, 3, "holding: the arm is held at rest until it is enabled") \
    X(FAULTED, 4, "faulted: a fault stands, drives off")                  \
    X(STOPPED, 5, "emergency stop: drives off until it is cleared")

/* X(name, code, text): why a command was not acknowledged. A rejected command changes nothing. */
#define REJECTION_LIST(X)                                                                \
    X(NOT_FINITE, 1, "a number is NaN or infinite")                                    \
    X(OUT_OF_RANGE, 2, "a number is outside its range")                                \
    X(WRONG_STATE, 3, "not in this state")                                             \
    X(OUTSIDE_LIMITS, 4, "a joint is outside its soft limits: enable to move back in") \
    X(POT_UNREAD, 5, "a potentiometer is not read")                                    \
    X(FAULT_STANDS, 6, "the cause of a fault still stands")                            \
    X(STOP_PRESSED, 7, "the emergency stop is still pressed")                          \
    X(UNKNOWN_COMMAND, 8, "unknown command")                                           \
    X(NO_HELLO, 9, "no hello of the board's own version came: only STOP is acknowledged")    \
    X(TOO_MANY, 10, "too many commands at once")                                       \
    X(CONFIG_BROKEN, 11, "the configuration came incomplete, or could not be stored")    \
    X(NOT_OWNER, 12, "another host has the session: say hello again")                                                \
    X(NOT_HOMED, 13, "an encoder does not know its zero: bring the arm to its home and give HOME")

#define FAULT_CODE(name, code, reaction, text) FAULT_##name = (code),
#define STATE_CODE(name, code, text) STATE_##name = (code),
#define REJECTION_CODE(name, code, text) REJECTION_##name = (code),
enum { FAULT_NONE = 0, FAULT_LIST(FAULT_CODE) FAULT_COUNT };
enum { STATE_LIST(STATE_CODE) STATE_COUNT };
enum { REJECTION_NONE = 0, REJECTION_LIST(REJECTION_CODE) REJECTION_COUNT };
#undef FAULT_CODE
#undef STATE_CODE
#undef REJECTION_CODE

/* What a fault does to a moving arm: HOLD stops it along its path and holds it. YIELD does so too, but the joint lets
 * itself be moved to where it is. JOINT shorts the windings of the joint and stops the others along their path. RELEASE
 * shorts the windings of all. SLEEP switches all drivers off, for one that drives by itself. CHOSEN is the
 * configuration's silence_reaction. */
enum {
    REACTION_HOLD = 1,
    REACTION_RELEASE = 2,
    REACTION_CHOSEN = 3,
    REACTION_YIELD = 4,
    REACTION_JOINT = 5,
    REACTION_SLEEP = 6,
};

#define FAULT_BIT(code) (1u << ((code) % 32u)) /* in a set of faults; code 0 is none, so 32 has its bit */

/* Why the board started. */
enum { RESET_POWER = 0, RESET_WATCHDOG = 1, RESET_CRASH = 2 };

/* Where a crash came from; all 0 where there was none. */
typedef struct crash_record {
    uint32_t exception; /* its number: 3 hard fault, 4 memory, 5 bus, 6 usage, 16 and more an unexpected interrupt */
    uint32_t pc;        /* the instruction */
    uint32_t lr;        /* who had called it */
    uint32_t cfsr;      /* the processor's configurable fault status */
} crash_record;

/* What a command asks for. */
enum {
    COMMAND_NONE = 0,
    COMMAND_MOVE = 1,
    COMMAND_ENABLE = 2,
    COMMAND_ENABLE_INWARD = 3,
    COMMAND_DISABLE = 4,
    COMMAND_CLEAR_FAULTS = 5,
    COMMAND_CLEAR_STOP = 6,
    COMMAND_GAINS = 7,
    COMMAND_HOME = 8,
};

/* What reads a joint's angle. */
enum { SENSOR_POTENTIOMETER = 0, SENSOR_QUADRATURE = 1, SENSOR_ABSOLUTE = 2 };

/* What a board has for joints: a configuration that asks for more is not valid there. */
typedef struct board_abilities {
    uint32_t joints;            /* how many, 1 to JOINTS */
    uint32_t sensors;           /* one bit 1 << SENSOR_... for each kind it reads */
    uint32_t quadrature_inputs; /* timers that count: inputs 1 to so many */
} board_abilities;

#define ENCODER_REV 16384u /* counts of an absolute encoder's revolution */

/* Beside the 14 bits of an absolute encoder's angle, in telemetry. */
enum { ENCODER_UNSOUND = 16384, ENCODER_MAGNET = 32768 };

/* What holds a joint back without being a fault, one bit each. */
enum {
    LIMITED_DUTY = 1,
    LIMITED_SLEW = 2,
    LIMITED_CURRENT = 4,
    LIMITED_SOFT = 8,
    LIMITED_SPEED = 16,
    LIMITED_ACCELERATION = 32,
};

/* Where a configuration came from. */
enum { CONFIG_NEWEST = 0, CONFIG_OLDER = 1, CONFIG_FACTORY = 2 };

/* The gains of one joint. */
typedef struct joint_gains {
    float kp_per_rad;          /* duty per rad of error, 0 to 100 */
    float ki_per_rad_s;        /* duty per second and rad of error, 0 to 1000 */
    float kd_s_per_rad;        /* duty per rad/s of measured speed, 0 to 100: damps */
    float kv_s_per_rad;        /* duty per rad/s of reference speed, 0 to 100: feed-forward */
    float ka_s2_per_rad;       /* duty per rad/s^2 of reference acceleration, 0 to 10: feed-forward */
    float kf_duty;             /* duty that dry friction takes, 0 to 1: feed-forward, with the reference's direction */
    float derivative_filter_s; /* time constant of the speed filter, 0 to 1: longer is smoother and later */
    float anti_windup_per_s;   /* how fast the integral gives way to a limit, 0 to 1000: 1/time constant */
} joint_gains;

/* A gain set: all joints at once, so that no tick ever sees half of it. */
typedef struct gain_set {
    joint_gains joint[JOINTS];
} gain_set;

/* How one potentiometer is read. */
typedef struct pot_config {
    uint16_t node_count;         /* 2 to POT_NODES: used nodes of the table */
    uint16_t counts[POT_NODES];  /* rising strictly over the used nodes */
    uint16_t short_counts;       /* below it the wiper is shorted to ground */
    uint16_t open_counts;        /* above it the wiper is open: a pull-up must lift it */
    float angle_rad[POT_NODES];  /* joint angle at each node before direction, strictly monotone, -13 to 13 */
    int32_t direction;           /* 1 or -1, multiplies the table's angle */
    float jump_rad;              /* largest change the joint can make in one tick, 1e-4 to 1 */
    float frozen_rad;            /* reference travel over which the counts must change, 1e-3 to 1 */
    float inverted_rad;          /* travel away from the command that is a push or an inversion, 1e-3 to 1 */
} pot_config;

/* The motor of one joint, at the joint: by these two the board knows its speed without the potentiometer. */
typedef struct motor_config {
    float resistance_ohm; /* 0 to 1000; 0: the motor is not watched */
    float constant_v_s;   /* 0.001 to 1000: V s/rad, gear included */
    float apart_rad;      /* 1e-3 to 1: how far motor and potentiometer may be apart: noise and backlash */
    float backlash_rad;   /* 0 to 1, below apart_rad: of the gear between them, from stop to stop */
} motor_config;

/* What lies between the motor and what reads the joint, where it is not rigid and even. */
typedef struct transmission_config {
    float twist_rad_per_a; /* 0 to 1: how far an ampere of motor current twists it */
    float uneven;          /* 0 to 0.5: by which share its ratio varies with the angle: an eccentric drum */
    float damping_share;   /* 0 to 1: of the speed that kd damps, the motor's own; the rest is the reading's */
} transmission_config;

/* The encoder of one joint. The joint is at home_rad where its counts are those of the zero: an absolute one's
 * zero_counts, a quadrature one's when COMMAND_HOME came. Of pot then only jump_rad, frozen_rad and inverted_rad
 * count. */
typedef struct encoder_config {
    uint32_t sensor;      /* SENSOR_...; the rest is not looked at for a potentiometer */
    uint32_t input;       /* 1 to JOINTS, no two joints' the same: which timer; quadrature only */
    float counts_per_rev; /* 16 to 1e7: of one revolution of the joint, four edges a line and the gear included */
    int32_t direction;    /* 1 or -1, multiplies the counts */
    uint32_t zero_counts; /* 0 to ENCODER_REV - 1; absolute only */
    float home_rad;       /* -13 to 13 */
} encoder_config;

/* The configuration of one joint. */
typedef struct joint_config {
    joint_gains gains;
    pot_config pot;
    motor_config motor;
    float soft_min_rad;        /* -13 to 13, below soft_max_rad */
    float soft_max_rad;        /* -13 to 13 */
    float speed_limit_rad_s;   /* 0.01 to 20: bounds the reference's speed */
    float deceleration_rad_s2; /* 0.1 to 1000: how a stop slows the reference down */
    float acceleration_rad_s2; /* 0.1 to 1000: bounds the reference's acceleration */
    float jerk_rad_s3;         /* 1 to 1e6: bounds how fast the reference's acceleration changes */
    float duty_limit;          /* 0 to 1 */
    float duty_slew_per_s;     /* 0.1 to 1000: largest change of duty */
    float gravity_slew_per_s;  /* 0.1 to 1000: largest change of the host's gravity duty */
    float current_cut_per_a_s; /* 0 to 1000: duty taken away per second and ampere beyond the limit */
    float following_rad;       /* 1e-3 to 13: largest distance from the reference */
    float stall_duty;          /* 0.01 to 1: from here on the motor must rotate the joint */
    float stall_rad;           /* 1e-4 to 1: rotating less than this within stall_ticks is standing still */
    uint32_t current_limit_ma; /* 10 to 500000: motor current from which the duty is cut */
    int32_t motor_direction;   /* 1 or -1, multiplies the duty on its way out */
    encoder_config encoder;    /* what reads the joint, where it is no potentiometer */
    transmission_config transmission;
} joint_config;

/* The configuration of the arm. Times are in ticks of 1 ms. */
typedef struct core_config {
    joint_config joint[JOINTS]; /* the first joint_count are used, the others are not looked at */
    uint32_t joint_count;       /* 1 to JOINTS */
    uint32_t supply_min_mv;     /* half of supply_nominal_mv or more, below supply_max_mv */
    uint32_t supply_max_mv;
    uint32_t supply_nominal_mv; /* duties and gains are those at this supply; 1000 to 100000 */
    uint32_t supply_ticks;     /* 1 to 1000: a supply fault must last as long */
    uint32_t pot_ticks;        /* 1 to 100: so must an open, short or jumping potentiometer */
    uint32_t following_ticks;  /* 1 to 10000: and a following error */
    uint32_t stall_ticks;      /* 1 to 10000: and a stall */
    uint32_t overload_ticks;   /* 1 to 10000: and an overload */
    uint32_t brake_release_ticks; /* 0 to 1000: how long brakes take to open; the reference waits */
    uint32_t brake_engage_ticks;  /* 0 to 1000: how long they take to close; the drives hold meanwhile */
    uint32_t silence_ticks;    /* 2 to 60000: longest time without a motion command */
    uint32_t silence_reaction; /* REACTION_HOLD or REACTION_RELEASE */
    uint32_t sync_led_pin;     /* 0: no sync LED; else 16 (port + 1) + pin, port 0 (A) to 7 (H): PC10 is 58 */
    uint32_t sync_led_ticks;   /* 1 to 100: how long each bit of the LED's code lasts */
} core_config;

/* One stored copy of the configuration. */
typedef struct config_copy {
    uint32_t magic;
    uint32_t version;
    uint32_t serial; /* rises by one with each copy written */
    core_config config;
    uint32_t crc; /* CRC-32 of everything before it */
} config_copy;

/* What a motion command asks of the joints. */
typedef struct move_command {
    float position_rad[JOINTS]; /* where to be when duration_ticks have passed; clamped to the soft limits */
    float speed_rad_s[JOINTS];  /* how fast to be there; clamped to the speed limits */
    float gravity_duty[JOINTS]; /* -1 to 1: duty that compensates the gravity load, added from the next tick on */
    uint32_t duration_ticks;    /* 1 to 10000: usually the host's own period */
} move_command;

/* One command of the host. */
typedef struct core_command {
    uint32_t kind;     /* COMMAND_... */
    uint32_t sequence; /* the host's number for it, given back when it is acknowledged or rejected */
    move_command move; /* read for COMMAND_MOVE only */
    gain_set gains;    /* read for COMMAND_GAINS only */
} core_command;

/* What a tick takes. */
typedef struct core_inputs {
    uint32_t tick;               /* the board's tick timer: one more each time, it may wrap */
    uint32_t overrun;            /* not 0: the last tick had not ended when this one was due */
    uint32_t stop_pressed;       /* not 0: an emergency stop is asked for, by button or by message */
    uint32_t taken_over;         /* not 0: another host began a session */
    uint32_t supply_mv;          /* motor supply */
    uint32_t counts[JOINTS];     /* what the joint's sensor reads: a potentiometer 0 to 65535; a quadrature timer, which
                                    wraps at 2^32; an AS5047's frames, its angle below and DIAAGC in the upper half */
    int32_t current_ma[JOINTS];  /* motor currents, positive where a positive duty drives them; 0 where not measured */
    core_command command;        /* COMMAND_NONE where none came since the last tick */
} core_inputs;

/* What a tick gives. */
typedef struct core_outputs {
    uint32_t tick;                /* the input's */
    uint32_t drives_on;           /* 0: the motors are not driven */
    uint32_t windings_shorted;    /* not 0 with drives_on 0: keep the bridges awake at duty 0, so that motors brake */
    uint32_t brakes_open;         /* not 0: release the brakes, where there are any */
    uint32_t feed_watchdog;       /* not 0: the tick ran to its end, the watchdog may be fed */
    uint32_t state;               /* STATE_... */
    uint32_t faults;              /* latched faults, FAULT_BIT of each */
    uint32_t joint_faults[JOINTS]; /* the same, those of each joint */
    uint32_t first_fault;         /* the fault that came first since the last clear, FAULT_NONE without */
    uint32_t first_joint;         /* its joint, NO_JOINT where it belongs to none */
    uint32_t acknowledged_sequence;     /* the last command acknowledged */
    uint32_t acknowledged_count;        /* how many were, it wraps */
    uint32_t rejected_sequence;    /* the last command rejected */
    uint32_t rejected_count;       /* how many were, it wraps */
    uint32_t rejection;             /* why that one was, REJECTION_... */
    uint32_t not_homed;           /* joints whose angle is counted from where nobody knows, one bit 1 << joint each */
    uint32_t limited[JOINTS];     /* LIMITED_... bits of this tick */
    float duty[JOINTS];           /* to the motors, -1 to 1 */
    float angle_rad[JOINTS];      /* measured */
    float speed_rad_s[JOINTS];    /* measured, filtered as the derivative is */
    float reference_rad[JOINTS];  /* where the joint is to be */
    float reference_rad_s[JOINTS]; /* how fast it is to move */
} core_outputs;

/* What the controller of one joint remembers. */
typedef struct pid_state {
    float integral_duty;
    float measured_rad;    /* last tick's, for the derivative */
    float speed_rad_s;     /* filtered derivative of the measurement */
    float duty;            /* last tick's, for the slew limit */
    float error_rad;       /* last tick's, for a bumpless change of gains */
    float reference_rad_s; /* likewise */
    float reference_rad_s2; /* likewise */
} pid_state;

/* What the controller of one joint is to reach and within which limits. */
typedef struct pid_demand {
    float reference_rad;
    float reference_rad_s;
    float reference_rad_s2;
    float spring_limit;    /* largest duty of kp and kv together: what moves a free joint at its speed limit */
    float gravity_duty;
    float duty_limit;      /* 0 to 1 */
    float duty_low;        /* -duty_limit to 0: what the current limit and a racing motor leave */
    float duty_high;       /* 0 to duty_limit: likewise */
    float duty_slew_per_s;
    float damped_rad_s;    /* the speed that is damped: the measured one, or the motor's where the reading is wrong */
    float braked_duty;     /* off it where an elastic joint's motor is beyond its limit: its integral gathers it */
    float own_s_per_rad;   /* duty that back-EMF takes per rad/s */
    float motor_rad_s;     /* the motor's speed by it, 0 where it is not watched */
} pid_demand;

/* The reference of one joint: a cubic from one point to the next, then straight on. */
typedef struct setpoint_state {
    float position_rad;
    float speed_rad_s;
    float from_rad;
    float from_rad_s;
    float square_rad_s2; /* the cubic's coefficients of t^2 and t^3 */
    float cube_rad_s3;
    float to_rad;
    float to_rad_s;
    uint32_t ticks;    /* length of the cubic */
    uint32_t elapsed;  /* ticks since its beginning */
} setpoint_state;

/* The reference within its limits: the path a setpoint asks for, followed as fast as acceleration and jerk allow. */
typedef struct governor_state {
    float position_rad;
    float speed_rad_s;
    float acceleration_rad_s2;
} governor_state;

#define MOTOR_SAMPLES 32u /* of a joint's last 256 ms */
#define MOTOR_KNOWN 4u    /* in which a fault does not spoil what was learnt */

/* What is remembered of one motor, watched by its own voltage and current. */
typedef struct motor_state {
    float duty;              /* put out in the last tick, direction of the joint */
    float speed_rad_s;       /* by the back-EMF */
    float unsure_rad_s;      /* how far that may be off */
    float doubt_rad_s;       /* the same, as far as it excuses a speed beyond the limit */
    float fastest_rad_s;     /* what it is held to: the speed limit, or what its noise lets show */
    float sure_rad_s;        /* the size it has at least but for the doubt; less than nothing where it is not known */
    uint32_t before;         /* not 0: it is known what the load took before that, */
    float before_v;          /* of the applied voltage less the back-EMF by the reading, */
    float before_a;          /* and as a current */
    float heard_rad_s;       /* up to this speed a current is heard of late; 0 while doubted, or a step was seen */
    float ohm;               /* learnt, as of the last sample */
    uint32_t sample_ticks;   /* driven_ticks when the next sample is taken */
    float rough_rad_s;       /* mean change of speed_rad_s from tick to tick */
    float way_seen;          /* squares of the way that showed what the constant is since a step, */
    float constant_seen;     /* over the learnt one, */
    float constant_sigma;
    uint32_t doubted;        /* not 0: it is no witness until the drives were off */
    float step_rad_s;        /* change of speed_rad_s in a tick that no torque makes */
    float last_a;            /* the current of the last tick, */
    float last_v;            /* and its applied voltage */
    float dither_vv;         /* sums of the changes of both from tick to tick: squares of the voltage's, */
    float dither_va;         /* products, */
    float dither_aa;         /* squares of the current's; fade */
    float dithers;           /* how many changes they hold; fades */
    float unsure_per_a;      /* rad/s by which speed_rad_s may be off for each ampere */
    float swift_per_a;       /* rad/s by which an ampere changes its speed in a tick */
    uint32_t step_ticks;     /* driven_ticks when that was last seen, 0: never */
    float part_v;            /* sums since the last sample: applied voltage, current; */
    float part_a;
    float part_rad;          /* reading then */
    uint32_t limited_ticks;  /* driven_ticks when a driver may last have limited the current; 0: never */
    uint32_t stepped_off;    /* not 0: motor_may_have_stepped as the drives went off, or since; until they are on */
    uint32_t part_ticks;     /* driven_ticks when the last sample was taken */
    float current_a;         /* the largest mean of a sample of late */
    float damped_rad_s;      /* the speed, smoothed */
    float beyond_rad_s;      /* what kd damps beyond the reading's speed */
    float twist_rad_per_a;   /* of the configuration's transmission */
    float twist_rad;         /* as far as the current has twisted it: at its resonance, noise of a duty does not */
    float twist_share;       /* of what is left, in a tick */
    float uneven;
    float damping_share;
    float gap_rad;           /* travel of the reading less that of the motor; fades */
    float withheld_rad;      /* how far the motor may have gone less, as its driver limited the current; fades */
    float band_rad;          /* how much of it the motor's uncertain numbers explain; fades */
    float last_rad;          /* the reading of the last tick */
    float resistance_scale;  /* learnt: over the configuration's */
    float constant_scale;
    float per_constant;      /* rad/s per V by the learnt constant, as of the last sample */
    float variance_rr;       /* of both scales */
    float variance_rk;
    float variance_kk;
    float window_v;          /* sums since the window began: applied voltage, */
    float window_ir_v;       /* what the configured resistance takes of it, */
    float window_rad;        /* the reading at its beginning */
    uint32_t window_ticks;
    float mean_v;            /* means of the last whole window: applied voltage, */
    float mean_ir_v;         /* what the configured resistance takes of it, */
    float mean_kw_v;         /* the back-EMF by reading and configured constant, */
    float mean_noise_v;      /* and what noise and backlash leave in that; */
    uint32_t mean_ticks;     /* its length, 0 once it counts in what follows */
    uint32_t mean_teaches;   /* not 0: motor and reading agreed as far as both scales may explain */
    float lately_rr;         /* what windows in motion say of both scales of late: squares and product over noise, */
    float lately_rk;
    float lately_kk;
    float lately_rv;         /* and their products with the voltage; */
    float lately_kv;
    float lately_vv;         /* squares of the voltage, */
    float lately_n;          /* and how many windows they hold; */
    float lately_tr;         /* the same by the time, s: square of R, */
    float lately_ttr;        /* twice, */
    float lately_tk;         /* its product with the constant, */
    float lately_tv;         /* and with the voltage; all fade */
    float known_k[MOTOR_KNOWN];  /* the constant's scale as it was learnt each KNOWN_TICKS of late, */
    float known_kk[MOTOR_KNOWN]; /* and its variance */
    uint32_t known;              /* how many of them there were */
    uint32_t weakened;           /* the faults of a constant that by these is less than it was; 0: none */
    int32_t window_side;     /* which way the last one went, 1 or -1, by a negative torque 2 or -2; 0: not known */
    uint32_t sampled;        /* samples taken */
    float trust;             /* of the speed limit: what it may use; 1 once motor and reading went the same way */
    float way_read_rad;      /* the way since the joint last rested, by the reading */
    float way_motor_rad;     /* and by the motor with the configured constant */
    float way_unsure_rad;    /* how far that may be off by its resistance */
    float way_mark_rad;      /* the reading's when it last got on */
    uint32_t way_ticks;      /* since then */
    uint32_t swing_since;    /* driven_ticks when the motor changed to the other side of the reference's speed, */
    uint32_t swing_seen;     /* and when it was last looked at far off it */
    float swing_shows_rad_s; /* sum of how far beyond the threshold it was in the looks in a row on a side, signed */
    uint32_t swings;         /* changes in quick succession */
    float swing_rad_s;       /* how far off it was at most since the last, signed, */
    float swing_stays_rad_s; /* sum of that over the second half of the changes, less a share of the first half's */
    uint32_t swing_ticks;    /* half a period of the joint on its spring: so long that gives back what it took */
    uint32_t fast_ticks;     /* faster than the limit, in a row */
    uint32_t none_samples;   /* in a row: no winding answers as it does */
    uint32_t current_ticks;  /* beyond twice the current limit, in a row */
    uint32_t driven_ticks;   /* since the windings were closed */
    uint32_t phase;          /* when it is sampled */
    float sample_read_rad[MOTOR_SAMPLES];
    float sample_v[MOTOR_SAMPLES]; /* sums since the sample before: applied voltage, V ticks, */
    float sample_a[MOTOR_SAMPLES]; /* and current, A ticks */
    uint32_t alone;              /* not 0: the reading is no witness; the motor holds the joint, nothing is learnt */
    float known_r[MOTOR_KNOWN];  /* the resistance's scale as known_k, */
    float known_rr[MOTOR_KNOWN]; /* and its variance */
} motor_state;

#define MOTOR_COLUMNS 5u
#define MOTOR_PRODUCTS 25u

/* Products of what a joint did over some samples, about their means (motor.c). */
typedef struct motor_sums {
    float of[MOTOR_PRODUCTS]; /* of columns i and j: at i MOTOR_COLUMNS + j */
    float at[MOTOR_COLUMNS];  /* a sample, */
    float sum[MOTOR_COLUMNS]; /* and the sum of all */
} motor_sums;

/* What is remembered of one potentiometer. */
typedef struct pot_state {
    uint32_t valid;        /* not 0 once a reading was within its band */
    uint32_t bad_ticks;    /* implausible readings in a row */
    uint32_t counts;       /* this tick's */
    uint32_t alive;        /* not 0: they have changed since mark_rad was set */
    float angle_rad;       /* the last plausible one */
    float mark_rad;        /* where the reference was when the counts last changed */
    int32_t towards;       /* which way the joint is driven to its command, 0 while it is braked */
    float farthest_rad;    /* how far that way it has been meanwhile */
} pot_state;

/* What is remembered of one encoder beside pot_state, which has its angle. */
typedef struct encoder_state {
    uint32_t counts;      /* this tick's; quadrature */
    uint32_t zero_counts; /* those at home_rad */
    uint32_t homed;       /* not 0: it is known that they are */
} encoder_state;

/* What the sensor of a current reads while the bridges sleep and none flows. */
typedef struct zero_state {
    float now_a;
    float before_a; /* when they last fell asleep */
    uint32_t ticks; /* since then */
} zero_state;

/* What is remembered of a joint whose motor is not watched: an observer by duty and reading. */
typedef struct observer_state {
    float position_rad; /* where it is, */
    float speed_rad_s;  /* how fast, */
    float load_duty;    /* and what of the duty its load takes */
    float usual_duty;   /* the same of late */
    float inertia;      /* learnt: over the configuration's */
    float pull_duty;    /* what of the duty accelerates it under its usual load, as late as load_duty is */
    float agreed_rad;   /* the way on which it answered to its duty, since the board is on */
    float driven_rad;   /* where it was when something else than its duty began to drive it */
} observer_state;

/* What is remembered of one joint. */
typedef struct joint_state {
    pid_state pid;
    setpoint_state setpoint;
    governor_state reference;
    pot_state pot;
    uint32_t released;       /* not 0: a fault took it out of the drive, its windings are shorted */
    uint32_t suspect;        /* the fault by which motor and reading disagreed, until it has its name */
    uint32_t suspect_ticks;  /* since then */
    float gravity_duty;      /* in use; it follows gravity_asked */
    float gravity_asked;
    float stop_rad_s2;       /* deceleration on the way to a stop along the path */
    float current_a;         /* the motor's, in the joint's direction, */
    float over_a;            /* and how far it is beyond its limit */
    float duty_cap;          /* what the current limit leaves of the duty limit */
    float low_rad;           /* soft limits, widened to the joint's position while it is brought back in */
    float high_rad;
    uint32_t following_ticks;
    uint32_t stall_ticks;
    uint32_t overload_ticks;
    float stall_mark_rad;    /* where the joint was when stall_ticks began */
    uint32_t held_back;      /* LIMITED_SOFT and LIMITED_SPEED of the last motion command */
    uint32_t limited;        /* LIMITED_... of this tick */
    encoder_state encoder;
    zero_state zero;
    observer_state observer;
    motor_state motor;
    float held_rad;          /* where its motor has brought it, while that holds it, */
    float held_rad_s;        /* and how fast, filtered */
} joint_state;

/* The whole controller. */
typedef struct core_state {
    uint32_t guard_head; /* a known word on either side: an erroneous write that passes through shows */
    joint_state joint[JOINTS];
    core_config config;
    uint32_t state;
    uint32_t started;        /* not 0 after the first tick */
    uint32_t tick;
    uint32_t silent_ticks;
    uint32_t by_motor;       /* not 0: a joint's transmission twists, or its motor's speed is damped, or holds it */
    float supply_v;          /* this tick's */
    uint32_t supply_bad_ticks;
    uint32_t missed;         /* ticks lost of late; fades */
    uint32_t shorted;        /* not 0: windings stay shorted while the drives are off */
    uint32_t stopped_ticks;  /* since an emergency stop, while they are */
    uint32_t closing;        /* not 0: the brakes close, the drives go off once they are */
    uint32_t brake_ticks;    /* until the brakes are open, or closed */
    gain_set start_gains;    /* those it started with: an oscillation goes back to them */
    uint32_t crc;            /* of the configuration, as far as this round has come */
    uint32_t crc_at;         /* bytes */
    uint32_t crc_right;      /* of the whole, if crc_known */
    uint32_t crc_known;
    uint32_t standing;       /* faults whose cause stands in this tick */
    uint32_t not_homed;      /* joints, one bit 1 << joint each */
    uint32_t faults;
    uint32_t joint_faults[JOINTS];
    uint32_t first_fault;
    uint32_t first_joint;
    motor_sums sums;         /* of the joint that is looked at; nothing is kept here */
    uint32_t permanent;      /* faults only a restart takes away */
    uint32_t acknowledged_sequence;
    uint32_t acknowledged_count;
    uint32_t rejected_sequence;
    uint32_t rejected_count;
    uint32_t rejection;
    uint32_t guard_tail;
} core_state;

#endif
