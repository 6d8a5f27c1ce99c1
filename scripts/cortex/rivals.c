// The servo's work in three kinds of numbers, on the same inputs: the firmware's own, floats without a
// unit for them, and scientific notation with four decimal digits. For scripts/bench firmware.
#include "device.h"
#include <string.h>

extern struct device the_device;

// digits * 10^power; 1000 <= |digits| <= 9999, or 0.
struct decimal {
    int16_t digits;
    int8_t power;
};

struct gains_float {
    float kp, ki, kd, velocity, emf_tq, resistance, emf, duty, limit;
};

struct gains_decimal {
    struct decimal kp, ki, kd, velocity, emf_tq, resistance, emf, duty, limit, minus_limit;
};

// What a period begins with.
static struct setpoint setpoint;
static int32_t measured_pq, error_before_pq, points[4];
static uint16_t phase;
static struct track track;
static struct servo servo;
static struct gains_float gf;
static struct gains_decimal gd;
static float integral_f, filter_f, points_f[4], phase_f, error_before_f, error_f, velocity_f,
    torque_f;
static struct decimal integral_d, filter_d, points_d[4], phase_d, error_before_d, error_d,
    velocity_d, torque_d;
static struct decimal half_d, sixth_d, eighth_d, share_d;

static struct decimal settle(int32_t digits, int32_t power) {
    if (digits >= 10000000 || digits <= -10000000) {
        digits /= 10000;
        power += 4;
    }
    while (digits > 9999 || digits < -9999) {
        digits /= 10;
        power++;
    }
    while (digits != 0 && digits < 1000 && digits > -1000) {
        digits *= 10;
        power--;
    }
    return (struct decimal){(int16_t)digits, (int8_t)power};
}

static struct decimal times(struct decimal a, struct decimal b) {
    return settle((int32_t)a.digits * b.digits, a.power + b.power);
}

static struct decimal plus(struct decimal a, struct decimal b) {
    static const int32_t powers[] = {1, 10, 100, 1000, 10000};
    if (a.digits == 0 || (b.digits != 0 && a.power < b.power)) {
        struct decimal other = a;
        a = b;
        b = other;
    }
    int32_t apart = a.power - b.power;
    if (b.digits == 0 || apart > 4)
        return a;
    return settle(a.digits * powers[apart] + b.digits, b.power);
}

static struct decimal minus(struct decimal a, struct decimal b) {
    b.digits = (int16_t)-b.digits;
    return plus(a, b);
}

static struct decimal within(struct decimal a, struct decimal least, struct decimal most) {
    if (minus(a, most).digits > 0)
        return most;
    return minus(a, least).digits < 0 ? least : a;
}

static struct decimal of_float(float value) {
    int32_t power = 0;
    float size = value < 0 ? -value : value;
    if (size == 0)
        return (struct decimal){0, 0};
    for (; size >= 1e4f; power++)
        size /= 10;
    for (; size < 1e3f; power--)
        size *= 10;
    return settle((int32_t)(value < 0 ? -size - 0.5f : size + 0.5f), power);
}

static float to_float(struct decimal value) {
    float result = value.digits;
    for (int32_t i = value.power; i > 0; i--)
        result *= 10;
    for (int32_t i = value.power; i < 0; i++)
        result /= 10;
    return result;
}

static float factor(struct scale scale) { return scale.mantissa / (float)(1u << scale.shift); }

static uint32_t lcg;

static int32_t any(int32_t limit) {
    lcg = lcg * 1664525u + 1013904223u;
    return (int32_t)((uint64_t)(lcg >> 8) * (uint32_t)(2 * limit + 1) >> 24) - limit;
}

// Inputs as a servo meets them, in all three kinds.
void rivals_prepare(uint32_t seed) {
    const struct servo_settings *s = &the_device.settings.servo;
    lcg = seed;
    points[0] = any(1 << 24);
    for (int32_t i = 1; i < 4; i++)
        points[i] = points[i - 1] + 20000 + any(4000);
    phase = (uint16_t)any(32767) + 32768u;
    memset(&track, 0, sizeof track);
    track_write(&track, 0, points, 4);
    track.end = 1000; // the points are not at its end
    error_before_pq = any(3 << 10);
    measured_pq = any(1 << 24);
    setpoint = (struct setpoint){.position_pq = measured_pq + error_before_pq + any(1 << 10),
                                 .velocity_pq = any(60000),
                                 .torque_tq = any(s->torque_limit_tq / 4),
                                 .kp = s->kp_tq,
                                 .ki = s->ki_tq,
                                 .kd = s->kd_tq,
                                 .feedback_limit_tq = SERVO_FEEDBACK_FREE,
                                 .integrate = true};
    servo = (struct servo){.primed = true,
                           .error_pq = error_before_pq,
                           .integral = any(s->torque_limit_tq),
                           .difference_sum = any(1 << 11)};
    gf = (struct gains_float){
        factor(s->kp_tq),         factor(s->ki_tq) / (1 << SERVO_INTEGRAL_BITS),
        factor(s->kd_tq),         factor(s->velocity_tq),
        factor(s->emf_tq),        factor(s->resistance_mV),
        factor(s->emf_mV),        factor(s->supply_duty),
        (float)s->torque_limit_tq};
    gd = (struct gains_decimal){of_float(gf.kp),       of_float(gf.ki),     of_float(gf.kd),
                                of_float(gf.velocity), of_float(gf.emf_tq), of_float(gf.resistance),
                                of_float(gf.emf),      of_float(gf.duty),   of_float(gf.limit),
                                of_float(-gf.limit)};
    integral_f = servo.integral / (float)(1 << SERVO_INTEGRAL_BITS);
    filter_f = servo.difference_sum / 8.0f;
    phase_f = phase / 65536.0f;
    error_before_f = (float)error_before_pq;
    error_f = (float)(setpoint.position_pq - measured_pq);
    velocity_f = (float)setpoint.velocity_pq;
    torque_f = (float)setpoint.torque_tq;
    integral_d = of_float(integral_f);
    filter_d = of_float(filter_f);
    phase_d = of_float(phase_f);
    error_before_d = of_float(error_before_f);
    error_d = of_float(error_f);
    velocity_d = of_float(velocity_f);
    torque_d = of_float(torque_f);
    half_d = of_float(0.5f);
    sixth_d = of_float(1 / 6.0f);
    eighth_d = of_float(0.125f);
    share_d = of_float(0.875f);
    for (int32_t i = 0; i < 4; i++) { // from the first one on: four digits hold no place
        points_f[i] = (float)(points[i] - points[0]);
        points_d[i] = of_float(points_f[i]);
    }
}

// Value, from the first point on, and rate: their sum.
int32_t spline_fixed(void) {
    struct instant at = {1, phase};
    track_load(&track, at.knot);
    const struct span *span = track_span(&track, at.knot);
    return span_value(span, at.phase) - points[0] + span_rate(span, at.phase);
}

int32_t spline_float(void) {
    const float *p = points_f, u = phase_f;
    float d0 = p[1] - p[0], d1 = p[2] - p[1], d2 = p[3] - p[2];
    float slope = (d0 + d1) * 0.5f, curve = d1 - d0, jerk = d2 - d1 - curve;
    float value =
        p[1] + curve * (1 / 6.0f) + u * (slope + u * (curve * 0.5f + u * jerk * (1 / 6.0f)));
    return (int32_t)(value + slope + u * (curve + u * jerk * 0.5f));
}

int32_t spline_decimal(void) {
    const struct decimal *p = points_d, u = phase_d;
    struct decimal d0 = minus(p[1], p[0]), d1 = minus(p[2], p[1]), d2 = minus(p[3], p[2]);
    struct decimal slope = times(plus(d0, d1), half_d), curve = minus(d1, d0);
    struct decimal jerk = minus(minus(d2, d1), curve), sixth = times(u, times(jerk, sixth_d));
    struct decimal inner = plus(times(curve, half_d), sixth);
    struct decimal value = plus(p[1], times(curve, sixth_d));
    value = plus(value, times(u, plus(slope, times(u, inner))));
    struct decimal rate = plus(curve, times(times(u, jerk), half_d));
    rate = plus(slope, times(u, rate));
    struct decimal sum = plus(value, rate);
    int32_t result = sum.digits;
    for (; sum.power > 0; sum.power--)
        result *= 10;
    return result;
}

int32_t pid_fixed(void) {
    return servo_step(&the_device.settings.servo, &servo, &setpoint, measured_pq);
}

int32_t pid_float(void) {
    float difference = error_f - error_before_f, error = error_f;
    integral_f += error * gf.ki;
    integral_f = integral_f > gf.limit ? gf.limit : integral_f < -gf.limit ? -gf.limit : integral_f;
    filter_f += difference * 0.125f - filter_f * 0.125f;
    float emf = filter_f * gf.emf_tq;
    float torque =
        error * gf.kp + difference * gf.kd + integral_f + velocity_f * gf.velocity + torque_f + emf;
    torque = torque > gf.limit ? gf.limit : torque < -gf.limit ? -gf.limit : torque;
    float voltage = (torque - emf) * gf.resistance + velocity_f * gf.emf;
    float duty = voltage * gf.duty;
    return (int32_t)(duty > SERVO_DUTY_MAX    ? SERVO_DUTY_MAX
                     : duty < -SERVO_DUTY_MAX ? -SERVO_DUTY_MAX
                                              : duty);
}

int32_t pid_decimal(void) {
    const struct decimal top = {3277, 1}, bottom = {-3277, 1};
    struct decimal difference = minus(error_d, error_before_d), error = error_d;
    integral_d = within(plus(integral_d, times(error, gd.ki)), gd.minus_limit, gd.limit);
    filter_d = plus(times(filter_d, share_d), times(difference, eighth_d));
    struct decimal emf = times(filter_d, gd.emf_tq);
    struct decimal torque = plus(times(error, gd.kp), times(difference, gd.kd));
    torque =
        plus(plus(torque, integral_d), plus(times(velocity_d, gd.velocity), plus(torque_d, emf)));
    torque = within(torque, gd.minus_limit, gd.limit);
    struct decimal voltage = times(minus(torque, emf), gd.resistance);
    voltage = plus(voltage, times(velocity_d, gd.emf));
    struct decimal duty = within(times(voltage, gd.duty), bottom, top);
    return (int32_t)to_float(duty);
}
