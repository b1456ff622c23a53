/*
 * PlushSense: sensors that find their offset and scale themselves. Only exports of models with such sensors hold this file.
 *
 * plushsense.c takes it in and calls, from top to bottom, read_sensors, share_sensors, begin_sensors and calibrate. The rules
 * are stated in PlushSense's Python (windows/self_calibration), which defines what is right.
 */
#ifndef PLUSH_CALIBRATE_H
#define PLUSH_CALIBRATE_H

#define MOST_SENSORS 64u
#define OTHER_SENSOR 128u /* added to the shift of a sensor that is no accelerometer */
#define MOST_READING (INT32_C(1) << 19) /* of an accelerometer that calibrates itself, so that its sums fit 64 bits */
#define LEAST_BLOCK_SHIFT 2u
#define MOST_BLOCK_SHIFT 8u

/* What is known of an accelerometer: sums over the blocks so far. */
typedef struct {
    int64_t first[3], second[6];           /* weighted sums of the means, and of their products */
    int64_t square, third[3], fourth;      /* of q, the square of the length, of q times the means, and of q times q */
    int32_t centre[3];
    uint32_t weight;
} plush_sphere;

#define PLUSH_KEPT 8

/* What is known of another sensor, of one channel or of three axes: sums of still blocks, and what follows. */
typedef struct {
    int64_t spread;                        /* with 10 fraction bits */
    int32_t kept[PLUSH_KEPT][3], rest[3];
    uint32_t spare;                        /* so that no compiler adds bytes of its own */
    uint16_t weight[PLUSH_KEPT];
} plush_quantiles;

/* A sensor that calibrates itself: the block at hand, what is known, and what follows. */
typedef struct plush_sensor {
    union {
        plush_sphere sphere;
        plush_quantiles quantiles;
    } of;
    int64_t squares, level;                /* of the block at hand; the variance of still blocks */
    int32_t base[3], sum[3], offset[3];    /* the first sample, from which all is measured; offset: with 4 fraction bits */
    uint32_t multiplier;
    uint16_t count;                        /* samples of the block at hand */
    uint8_t begun, down, exponent;         /* exponent: of the sums of a sphere; of the blocks of an interval */
    uint8_t kept, blocks, spare;           /* kept blocks; blocks of the interval at hand */
} plush_sensor;

/* The sensors that calibrate themselves: of each, three channels, or one three times, and shift and kind. */
PLUSH_SMALL static int read_sensors(plush_toy *toy, source *from)
{
    const uint8_t *p = next_bytes(from, 1), *range;
    uint32_t n, i, k;

    toy->sensors = p == NULL ? 0 : *p;
    toy->sensor_plan = p = next_bytes(from, 4u * toy->sensors);
    if (p == NULL || toy->sensors == 0 || toy->sensors > MOST_SENSORS)
        return 0;
    for (n = 0; n < 4u * toy->sensors; n += 4) {
        uint32_t other = p[n + 3] / OTHER_SENSOR, shift = p[n + 3] % OTHER_SENSOR;

        if (shift < LEAST_BLOCK_SHIFT || shift > MOST_BLOCK_SHIFT)
            return 0;
        for (i = n; i < n + 3; i++) {
            if (p[i] >= toy->channels)
                return 0;
            range = toy->ranges + RANGE_BYTES * p[i];
            if (as_signed(word_at(range)) < -MOST_READING * (other ? 2 : 1)
                || as_signed(word_at(range + 4)) > MOST_READING * (other ? 2 : 1))
                return 0;
            /* What a sensor puts in place of a reading is no reading for another. */
            for (k = 0; k < i; k++)
                if (k % 4 != 3 && p[k] == p[i] && !(other && k >= n && p[n] == p[n + 1] && p[n] == p[n + 2]))
                    return 0;
        }
    }
    return 1;
}

/* Memory of the sensors, at a multiple of 8 for its 64-bit numbers. */
PLUSH_SMALL static void share_sensors(plush_toy *toy, uint8_t *memory, uint32_t *used)
{
    uint8_t *piece = (uint8_t *)take(memory, used, (uint32_t)sizeof(plush_sensor) * toy->sensors + 4u);

    toy->sensor = (plush_sensor *)(void *)(piece == NULL || (uintptr_t)piece % 8u == 0 ? piece : piece + 4);
}

/* Nothing is known of any sensor yet. */
PLUSH_SMALL static void begin_sensors(plush_toy *toy)
{
    memset(toy->sensor, 0, sizeof *toy->sensor * toy->sensors);
}

/* ---- Self-calibration: windows/self_calibration ----------------------------------------------------------------- */

#define MEAN_SIZE_BITS 12u
#define SHARE_BITS 14u
#define MOST_WEIGHT (UINT32_C(1) << 22)
#define LEAST_RADIUS 256
#define MOST_VARIANCE ((INT64_C(1) << 47) - 1)
#define VARIANCE_OF_STEPS 256
#define SWEEPS 8u
#define SQUARE_BITS 6u
#define MINOR_BITS 20u
#define MOST_OUTPUT 32767
#define MOST_CENTRE (INT64_C(4) << 20)
#define MOST_INTERVAL_BITS 7u
#define LEAST_SPREAD 64u
#define SPREAD_BITS 10u

/* Halves, or quarters and so on, toward 0. */
PLUSH_SMALL static void divide(int64_t *sums, uint32_t n, int64_t by)
{
    for (; n > 0; n--)
        *sums++ /= by;
}

/* Halves the sums for the weight n; if that is odd, their mean leaves once first. */
PLUSH_SMALL static void halve(int64_t *sums, uint32_t count, int64_t n)
{
    for (; count > 0; count--, sums++)
        *sums = (*sums - (n & 1) * (*sums / n)) / 2;
}

/* The product of a symmetric matrix and a vector. */
PLUSH_SMALL static int64_t row_times(const int64_t *a, uint32_t row, const int64_t *v)
{
    static const uint8_t place[9] = {0, 3, 4, 3, 1, 5, 4, 5, 2};
    int64_t sum = 0;
    uint32_t j;

    for (j = 0; j < 3; j++)
        sum += a[place[3 * row + j]] * v[j];
    return sum;
}

/* At most the smallest eigenvalue of a covariance, at least a third of it. */
PLUSH_SMALL static int64_t least_eigenvalue(const int64_t *a)
{
    int64_t m[6], minors, first, second, most = a[0] > a[1] ? a[0] : a[1];
    uint32_t down = 0, i;

    for (most = most > a[2] ? most : a[2]; most >> MINOR_BITS != 0; most >>= 1)
        down++;
    for (i = 0; i < 6; i++)
        m[i] = a[i] / (INT64_C(1) << down);
    first = m[1] * m[2] - m[5] * m[5];
    minors = first + m[0] * m[2] - m[4] * m[4] + m[0] * m[1] - m[3] * m[3];
    second = m[0] * first - m[3] * (m[3] * m[2] - m[5] * m[4]) + m[4] * (m[3] * m[5] - m[1] * m[4]);
    return second > 0 ? second / (minors > 1 ? minors : 1) * (INT64_C(1) << down) : 0;
}

/* The mean of a block, with its weight, into the sums. */
PLUSH_SMALL static void add_mean(plush_sensor *sensor, int64_t weight)
{
    plush_sphere *s = &sensor->of.sphere;
    int64_t m[3], squared = 0;
    uint32_t top = 0, i, n = 3;

    for (i = 0; i < 3; i++)
        top |= distance_of(sensor->sum[i], 0);
    for (; top >> (sensor->exponent + MEAN_SIZE_BITS) != 0; sensor->exponent++) {
        divide(s->first, 3, 2);
        divide(s->second, 6, 4);
        divide(&s->square, 1, 4);
        divide(s->third, 3, 8);
        divide(&s->fourth, 1, 16);
        for (i = 0; i < 3; i++)
            s->centre[i] /= 2;
    }
    for (i = 0; i < 3; i++) {
        m[i] = sensor->sum[i] / (INT32_C(1) << sensor->exponent);
        squared += m[i] * m[i];
    }
    squared >>= SQUARE_BITS;
    s->weight += (uint32_t)weight;
    s->square += weight * squared;
    s->fourth += weight * squared * squared;
    for (i = 0; i < 3; i++) {
        s->first[i] += weight * m[i];
        s->third[i] += weight * m[i] * squared;
        s->second[i] += weight * m[i] * m[i];
    }
    s->second[n++] += weight * m[0] * m[1];
    s->second[n++] += weight * m[0] * m[2];
    s->second[n] += weight * m[1] * m[2];
    if (s->weight > MOST_WEIGHT) {
        halve(s->first, 3, s->weight);
        halve(s->second, 6, s->weight);
        halve(&s->square, 1, s->weight);
        halve(s->third, 3, s->weight);
        halve(&s->fourth, 1, s->weight);
        s->weight >>= 1;
    }
}

/* The multiplier and shift by which readings with 4 fraction bits become 2048 for a scale, given that times 2^-more. */
PLUSH_SMALL static void set_scale(plush_sensor *s, uint32_t scale, int32_t more)
{
    uint32_t bits = 0;

    while (scale >> bits != 0)
        bits++;
    s->multiplier = (uint32_t)((UINT64_C(1) << (bits + 15)) / scale);
    s->down = (uint8_t)((int32_t)bits + more);
}

/* The centre moves toward the solution of A d = b; offset and scale follow. All with 8 fraction bits, products with 16. */
PLUSH_SMALL static void fit_sphere(plush_sensor *sensor, uint32_t shift)
{
    plush_sphere *s = &sensor->of.sphere;
    int64_t n = s->weight != 0 ? (int64_t)s->weight : 1, mean[3], a[6], b[3], d[3], k[3], whole = s->square / n;
    int64_t over = s->square - whole * n, noise, most, squared = 0, least;
    uint64_t size = UINT64_C(1) << 16;
    uint32_t radius, i, j;

    noise = (s->fourth - whole * s->square - whole * over) / n * (INT64_C(1) << (2 * SQUARE_BITS + 3));
    for (i = 0; i < 6; i++) {
        int64_t one = s->first[i < 3 ? i : i == 5 ? 1 : 0], other = s->first[i < 3 ? i : i == 3 ? 1 : 2];

        a[i] = (s->second[i] - one / n * other - (one - one / n * n) * other / n) * 256 / n;
    }
    for (i = 0; i < 3; i++) {
        mean[i] = s->first[i] * 65536 / n;
        k[i] = (s->third[i] - whole * s->first[i] - over * s->first[i] / n) * 256 / n * (INT64_C(1) << (SQUARE_BITS + 7));
    }
    for (i = 0; i < 3; i++)
        b[i] = k[i] - row_times(a, i, mean) / 256;
    for (i = 0; i < 3; i++) {
        mean[i] /= 256;
        d[i] = s->centre[i] - mean[i];
        squared += d[i] * d[i];
    }
    for (i = 0; i < 3; i++)
        noise -= s->centre[i] * ((k[i] + b[i] - row_times(a, i, d)) / (INT32_C(1) << 19));
    squared = ((a[0] + a[1] + a[2]) * 256 + squared) >> 16;
    noise = noise > 0 ? 8 * noise / (squared > 1 ? squared : 1) : 0;
    most = least_eigenvalue(a);
    noise = noise < most ? noise : most;
    for (j = 0; j < 3 * SWEEPS; j++) {
        i = j % 3;
        most = a[i] > noise ? a[i] - noise : 0;
        d[i] = (b[i] - row_times(a, i, d) + a[i] * d[i]) / (most + 1);
        d[i] = d[i] < -MOST_CENTRE ? -MOST_CENTRE : d[i] > MOST_CENTRE ? MOST_CENTRE : d[i];
    }
    least = sensor->level >> (2 * sensor->exponent);
    least = (least < INT64_C(1) << 36 ? least : INT64_C(1) << 36) * LEAST_RADIUS * 65536;
    squared = (a[0] + a[1] + a[2]) * 256;
    for (i = 0; i < 3; i++)
        squared += d[i] * d[i];
    if (squared < least)
        squared = least;
    if (squared > (int64_t)size)
        size = (uint64_t)squared;
    radius = square_root(size);
    set_scale(sensor, radius, (int32_t)sensor->exponent - (int32_t)shift);
    for (i = 0; i < 3; i++) {
        int64_t centre = mean[i] + d[i];

        s->centre[i] = (int32_t)centre;
        sensor->offset[i] = 16 * sensor->base[i] + (int32_t)(centre * (INT32_C(1) << sensor->exponent) / (INT32_C(16) << shift));
    }
}

/* At the end of an interval: of every two kept blocks the stiller one stays, when there are enough; then rest. */
PLUSH_SMALL static void find_rest(plush_sensor *s, uint32_t axes)
{
    plush_quantiles *q = &s->of.quantiles;
    uint32_t i, j, k, below, whole = 0;

    s->blocks = 0;
    if (++s->kept == PLUSH_KEPT) {
        for (i = 0; i < PLUSH_KEPT / 2; i++) {
            k = 2 * i + (q->weight[2 * i + 1] > q->weight[2 * i]);
            q->weight[i] = q->weight[k];
            for (j = 0; j < 3; j++)
                q->kept[i][j] = q->kept[k][j];
        }
        s->kept = PLUSH_KEPT / 2;
        if (s->exponent < MOST_INTERVAL_BITS)
            s->exponent++;
    }
    for (i = 0; i < s->kept; i++)
        whole += q->weight[i];
    for (i = 0; i < axes; i++) {
        q->rest[i] = INT32_MAX;
        for (j = 0; j < s->kept; j++) {
            for (below = 0, k = 0; k < s->kept; k++)
                if (q->kept[k][i] <= q->kept[j][i])
                    below += q->weight[k];
            if (2 * below >= whole && q->kept[j][i] < q->rest[i])
                q->rest[i] = q->kept[j][i];
        }
    }
}

/* Keeps the block if it is the stillest of its interval so far; offset and scale follow from rest and spread. */
PLUSH_SMALL static void fit_quantiles(plush_sensor *s, uint32_t axes, uint32_t shift, int64_t squared, int64_t weight)
{
    plush_quantiles *q = &s->of.quantiles;
    int64_t least = square_root((uint64_t)s->level * LEAST_SPREAD), spread, distance;
    uint32_t i;

    if (s->blocks == 0 || weight > q->weight[s->kept]) {
        q->weight[s->kept] = (uint16_t)weight;
        memcpy(q->kept[s->kept], s->sum, sizeof s->sum);
    }
    if (++s->blocks >> s->exponent != 0)
        find_rest(s, axes);
    for (i = 0; i < axes; i++) {
        distance = (int64_t)s->sum[i] - q->rest[i];
        squared += distance * distance;
    }
    distance = square_root((uint64_t)squared);
    least = least > 1 ? least : 1;
    spread = q->spread >> SPREAD_BITS;
    spread = spread > least ? spread : least;
    if (distance > spread)
        q->spread = (distance < 2 * spread ? distance : 2 * spread) * (INT32_C(1) << SPREAD_BITS);
    else if (distance > least)
        q->spread -= q->spread >> SPREAD_BITS;
    spread = q->spread >> SPREAD_BITS;
    set_scale(s, (uint32_t)(spread > least ? spread : least), 8 - (int32_t)shift);
    for (i = 0; i < axes; i++)
        s->offset[i] = 16 * s->base[i] + (int32_t)((int64_t)q->rest[i] * 16 / (INT32_C(1) << shift));
}

/* A complete block of a sensor with one or three axes. */
PLUSH_SMALL static void end_block(plush_sensor *s, uint32_t axes, uint32_t shift, uint32_t other)
{
    int64_t squared = s->squares * (INT32_C(1) << shift), variance, share;
    uint32_t i;

    for (i = 0; i < axes; i++)
        squared -= (int64_t)s->sum[i] * s->sum[i];
    variance = squared + (other ? (int64_t)axes << (2 * shift - 3) : VARIANCE_OF_STEPS);
    if (variance > MOST_VARIANCE)
        variance = MOST_VARIANCE;
    if (s->level == 0)
        s->level = variance;
    share = s->level * (INT32_C(1) << SHARE_BITS) / (variance + s->level);
    s->level += variance < s->level ? -(s->level >> 2) : s->level >> 5;
    share = share * share >> SHARE_BITS;
    if (other) {
        fit_quantiles(s, axes, shift, squared, share);
    } else {
        add_mean(s, share);
        fit_sphere(s, shift);
    }
    s->count = 0;
    s->squares = 0;
    memset(s->sum, 0, sizeof s->sum);
}

/* The even sample, with calibrated channels around their zeros. */
PLUSH_CODE
static void calibrate(plush_toy *toy)
{
    const uint8_t *plan = toy->sensor_plan;
    plush_sensor *s = toy->sensor;
    uint32_t n, i;

    for (n = 0; n < toy->sensors; n++, s++, plan += 4) {
        uint32_t axes = plan[0] == plan[1] ? 1 : 3, shift = plan[3] % OTHER_SENSOR;

        for (i = 0; i < axes; i++) {
            int32_t *sample = toy->sample + plan[i], x = *sample, y;
            int64_t out = 0;

            if (!s->begun)
                s->base[i] = x;
            if (s->multiplier != 0) {
                int64_t half_one = INT64_C(1) << (s->down - 1);

                out = ((int64_t)16 * x - s->offset[i]) * (int64_t)s->multiplier + half_one;
                out = out >= 0 ? out >> s->down : ~(~out >> s->down);
                out = out < -MOST_OUTPUT ? -MOST_OUTPUT : out > MOST_OUTPUT ? MOST_OUTPUT : out;
            }
            *sample = as_signed((uint32_t)(int32_t)out + le32(toy->ranges + RANGE_BYTES * plan[i] + 8));
            y = x - s->base[i];
            s->sum[i] += y;
            s->squares += (int64_t)y * y;
        }
        s->begun = 1;
        if (++s->count >> shift != 0)
            end_block(s, axes, shift, plan[3] / OTHER_SENSOR);
    }
}

#endif
