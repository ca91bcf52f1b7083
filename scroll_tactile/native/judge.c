#include "judge.h"

#include <stddef.h>
#include <string.h>

enum {
    DENSE = 4,            /* widths: so long begin narrow windows densely */
    MOST_DENSE = 40,      /* windows that begin there */
    PERIOD_BITS = 23,     /* of the triangle wave */
    STEP_BITS = 16,       /* of one step of it: 2^22 is 64 of them */
    FINE = 16,            /* statistics are kept to 1/16 of a level */
    MOST_Z_BITS = 26, MOST_U_BITS = 30, MOST_DISTANCE_BITS = 32
};

/* Quotients and shifts that round down, as Python's. */
static int64_t floor_divided(int64_t value, int64_t by)
{
    const int64_t quotient = value / by;
    return quotient * by > value ? quotient - 1 : quotient;
}

static int64_t shifted(int64_t value, int32_t bits) { return value >= 0 ? value >> bits : ~(~value >> bits); }

static int64_t within(int64_t value, int32_t bits)
{
    const int64_t most = (int64_t)1 << bits;
    return value > most ? most : value < -most ? -most : value;
}

void tactile_begin(tactile_touch *touch) { touch->readings = touch->clipped = 0; }

int tactile_push(tactile_touch *touch, const int16_t *reading)
{
    const tactile_memory *memory = touch->memory;
    const int32_t at = touch->readings;
    if (at >= memory->capacity)
        return 0;
    for (int32_t c = 0; c < memory->channels; c++) {
        int16_t *own = touch->levels + (ptrdiff_t)c * memory->capacity + at, level = reading[c];
        if (level == TACTILE_MISSING_LEVEL)
            level = at ? own[-1] : 0;
        if (level > TACTILE_LEVELS || level < -TACTILE_LEVELS) {
            level = level > 0 ? TACTILE_LEVELS : -TACTILE_LEVELS;
            touch->clipped++;
        }
        *own = level;
    }
    touch->readings++;
    return 1;
}

/* The first readings of the windows that judge so many readings, as signals/windows.py has them; returns how many. */
static int32_t window_starts(int32_t steps, int32_t width, int dense, int32_t *starts)
{
    const int32_t room = steps > width ? steps - width : 0, sixth = width / 6 > 1 ? width / 6 : 1;
    int32_t begin[MOST_DENSE] = {0}, dense_count = 0, stride = width, first = 0, found = 0;
    if (dense) {
        int32_t last = 0, inside = 1;
        while (last < (room < DENSE * width ? room : DENSE * width)) {
            last += sixth > last / 3 ? sixth : last / 3;
            if (last <= room)
                begin[inside++] = last;
        }
        dense_count = inside;
        first = last + width;
    } else {
        const int32_t half = width / 2 < room / 2 ? width / 2 : room / 2;
        stride = sixth > half ? sixth : half;
    }
    const int32_t count = dense_count + (first <= room ? (room - first) / stride + 1 : 0);
    const int32_t kept = count < TACTILE_MOST_WINDOWS ? count : TACTILE_MOST_WINDOWS;
    for (int32_t i = 0; i < kept; i++) {
        /* Evenly spread over more: the nearest place; there are no ties, as 63 is odd. */
        const int32_t spread = TACTILE_MOST_WINDOWS - 1;
        const int32_t place = kept == count ? i : (int32_t)(((int64_t)2 * i * (count - 1) + spread) / (2 * spread));
        const int32_t start = place < dense_count ? begin[place] : first + stride * (place - dense_count);
        if (!found || !dense || start >= starts[found - 1] + width / 2)
            starts[found++] = start;
    }
    return found;
}

static int32_t reach(const tactile_touch *touch, const tactile_scale *scale)
{
    return scale->width < touch->readings ? scale->width : touch->readings;
}

/* The segments into which the windows of some scales cut the places of a dilation; returns how many edges. */
static int32_t cut(tactile_touch *touch, int32_t scales, int32_t span)
{
    int32_t count = 0;
    for (int32_t k = 0; k < scales; k++) {
        const int32_t places = reach(touch, &touch->memory->scales[k]) - span;
        for (int32_t w = 0; places > 0 && w < 2 * touch->windows[k]; w++) {
            const int32_t edge = touch->starts[k][w / 2] + (w % 2 ? places : 0);
            int32_t at = count;
            while (at > 0 && touch->edges[at - 1] > edge)
                at--;
            if (at > 0 && touch->edges[at - 1] == edge)
                continue;
            memmove(touch->edges + at + 1, touch->edges + at, (size_t)(count - at) * sizeof *touch->edges);
            touch->edges[at] = edge;
            count++;
        }
    }
    return count;
}

static int32_t segment_of(const tactile_touch *touch, int32_t count, int32_t edge)
{
    int32_t low = 0, high = count - 1;
    while (low < high) {
        const int32_t middle = (low + high) / 2;
        if (touch->edges[middle] < edge)
            low = middle + 1;
        else
            high = middle;
    }
    return low;
}

static void weigh(tactile_touch *touch, int32_t k, int32_t feature, int32_t sum)
{
    const int32_t materials = touch->memory->materials;
    const int16_t *weights = touch->memory->scales[k].weights + (ptrdiff_t)feature * materials;
    int64_t *sums = touch->sums[k];
    for (int32_t m = 0; m < materials; m++)
        sums[m] += (int64_t)weights[m] * sum;
}

/* The proportions of one dilation: counted, turned to features, added up over the windows of a scale, weighed. */
static void weigh_dilation(tactile_touch *touch, int32_t scales, int32_t d, int32_t *begins)
{
    const tactile_memory *memory = touch->memory;
    const tactile_bank *bank = &memory->banks[d];
    const int32_t span = TACTILE_SPAN * bank->dilation;
    int32_t *responses = touch->work + 3 * memory->capacity, most = 0;
    /* `starts` become pairs of segments, in the low and the high half of a number. */
    int32_t pairs[TACTILE_MOST_SCALES][TACTILE_MOST_WINDOWS];
    const int32_t edges = cut(touch, scales, span);
    for (int32_t k = 0; k < scales; k++) {
        const int32_t places = reach(touch, &memory->scales[k]) - span, share = memory->scales[k].shares[d];
        most = share > most ? share : most;
        for (int32_t w = 0; share && w < touch->windows[k]; w++) {
            const int32_t start = touch->starts[k][w];
            pairs[k][w] = segment_of(touch, edges, start) | segment_of(touch, edges, start + places) << 16;
        }
    }
    for (int32_t kernel = 0; kernel < bank->kernels && kernel < most; kernel++) {
        tactile_respond(bank, kernel, touch->levels, memory->capacity, touch->readings, touch->work, responses);
        for (int32_t feature = kernel; feature < most; feature += bank->kernels) {
            tactile_exceeding(responses, bank->thresholds[feature], touch->edges, edges - 1, touch->before);
            for (int32_t k = 0; k < scales; k++) {
                const int32_t places = reach(touch, &memory->scales[k]) - span;
                int32_t sum = 0;
                if (feature >= memory->scales[k].shares[d])
                    continue;
                for (int32_t w = 0; w < touch->windows[k]; w++) {
                    const int32_t count = touch->before[pairs[k][w] >> 16] - touch->before[pairs[k][w] & 0xffff];
                    sum += memory->angles[(count * TACTILE_ANGLES + places / 2) / places];
                }
                weigh(touch, k, begins[k] + feature, sum);
            }
        }
    }
    for (int32_t k = 0; k < scales; k++)
        begins[k] += memory->scales[k].shares[d];
}

static int64_t square_root(int64_t value)
{
    int64_t root = 0;
    for (int64_t bit = (int64_t)1 << 30; bit; bit >>= 1)
        if ((root + bit) * (root + bit) <= value)
            root += bit;
    return root;
}

/* Level, spread, roughness and trend of a channel in a window, in 1/16 of a level. */
static void measure(const int16_t *values, int32_t length, int32_t *statistics, int32_t channels)
{
    const int32_t third = length / 3 > 1 ? length / 3 : 1;
    int64_t total = 0, squares = 0, steps = 0, trend = 0;
    for (int32_t t = 0; t < length; t++) {
        const int32_t step = t ? values[t] - values[t - 1] : 0;
        total += values[t];
        squares += values[t] * values[t];
        steps += step < 0 ? -step : step;
        trend += t >= length - third ? values[t] : 0;
        trend -= t < third ? values[t] : 0;
    }
    statistics[0] = (int32_t)floor_divided(total * FINE, length);
    statistics[channels] = (int32_t)(square_root((length * squares - total * total) * FINE * FINE) / length);
    statistics[2 * channels] = (int32_t)(steps * FINE / (length > 1 ? length - 1 : 1));
    statistics[3 * channels] = (int32_t)floor_divided(trend * FINE, third);
}

static void weigh_triangles(tactile_touch *touch, int32_t k, int32_t begin)
{
    const tactile_memory *memory = touch->memory;
    const tactile_scale *scale = &memory->scales[k];
    memset(touch->triangles, 0, (size_t)scale->triangles * sizeof *touch->triangles);
    for (int32_t w = 0; scale->triangles && w < touch->windows[k]; w++) {
        for (int32_t c = 0; c < memory->channels; c++)
            measure(touch->levels + (ptrdiff_t)c * memory->capacity + touch->starts[k][w], reach(touch, scale),
                    touch->statistics + c, memory->channels);
        for (int32_t i = 0; i < scale->triangles; i++) {
            uint32_t turned = scale->phases[i]; /* modulo 2^23, so modulo 2^32 is enough */
            for (int32_t term = scale->begins[i]; term < scale->begins[i + 1]; term++)
                turned += (uint32_t)scale->factors[term] * (uint32_t)touch->statistics[scale->inputs[term]];
            turned &= ((uint32_t)1 << PERIOD_BITS) - 1;
            const uint32_t middle = (uint32_t)1 << (PERIOD_BITS - 1), half = (uint32_t)1 << (STEP_BITS - 1);
            const uint32_t away = turned > middle ? turned - middle : middle - turned, rest = away & (2 * half - 1);
            const uint32_t whole = away >> STEP_BITS, up = rest > half || (rest == half && whole % 2);
            touch->triangles[i] += (int32_t)((whole + up) * (TACTILE_ONE / 64));
        }
    }
    for (int32_t i = 0; i < scale->triangles; i++)
        weigh(touch, k, begin + i, touch->triangles[i]);
}

/* z of a scale in place of its sums; returns the relative Mahalanobis distance. */
static int64_t settle(tactile_touch *touch, int32_t k)
{
    const tactile_scale *scale = &touch->memory->scales[k];
    const int32_t materials = touch->memory->materials;
    int64_t *z = touch->sums[k], best = INT64_MIN, whole = 0;
    for (int32_t m = 0; m < materials; m++) {
        z[m] = within(shifted(floor_divided(z[m], touch->windows[k]), scale->shift) + scale->offsets[m], MOST_Z_BITS);
        best = z[m] - scale->halves[m] > best ? z[m] - scale->halves[m] : best;
    }
    for (int32_t m = 0; m < materials; m++) {
        int64_t u = 0;
        for (int32_t other = 0; other < materials; other++)
            u += scale->background[(ptrdiff_t)m * materials + other] * z[other];
        whole += within(shifted(u, scale->background_shift), MOST_U_BITS) * z[m];
    }
    return within(shifted(whole, 16) - 2 * best, MOST_DISTANCE_BITS);
}

static void chances(const tactile_memory *memory, tactile_answer *answer)
{
    int64_t total = 0;
    answer->material = 0;
    for (int32_t m = 1; m < memory->materials; m++)
        if (answer->scores[m] > answer->scores[answer->material])
            answer->material = m;
    for (int32_t m = 0; m < memory->materials; m++) {
        const int64_t behind = (answer->scores[answer->material] - answer->scores[m]) >> 18;
        total += behind < TACTILE_CHANCES ? memory->chances[behind] : 0;
    }
    answer->probability = (int32_t)((int64_t)65535 * memory->chances[0] / total);
}

void tactile_judge(tactile_touch *touch, tactile_answer *answer)
{
    const tactile_memory *memory = touch->memory;
    const tactile_stage *stage = NULL;
    int32_t begins[TACTILE_MOST_SCALES] = {0};
    memset(answer, 0, sizeof *answer);
    answer->readings = touch->readings;
    answer->material = answer->known = -1;
    for (int32_t s = 0; s < memory->stages_count && memory->stages[s].least <= touch->readings; s++)
        stage = &memory->stages[s];
    if (stage == NULL)
        return;
    memset(touch->sums, 0, sizeof touch->sums);
    for (int32_t k = 0; k < stage->scales; k++)
        touch->windows[k] = window_starts(touch->readings, memory->scales[k].width, k == 0, touch->starts[k]);
    for (int32_t d = 0; d < memory->dilations; d++)
        weigh_dilation(touch, stage->scales, d, begins);
    answer->novelty = -stage->threshold;
    for (int32_t k = 0; k < stage->scales; k++) {
        weigh_triangles(touch, k, begins[k]);
        const int64_t distance = settle(touch, k);
        answer->novelty += shifted(stage->distance_weights[k] * distance, stage->distance_shifts[k]);
        for (int32_t m = 0; m < memory->materials; m++)
            answer->scores[m] += stage->weights[k] * (touch->sums[k][m] - memory->scales[k].halves[m]);
    }
    answer->known = answer->novelty > 0 ? 0 : stage->detects ? 1 : -1;
    chances(memory, answer);
}
