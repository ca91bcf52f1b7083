/* The exported judge: what a touch feels like, in whole numbers, without an allocation: see firmware/exported_judge.py.
 *
 * Proportions of windows (kernels.h) and triangle features of their levels are weighed for each material, scale by scale;
 * the sums give its scores, a probability, and how far the touch lies from all that was learned.
 */
#ifndef SCROLL_TACTILE_JUDGE_H
#define SCROLL_TACTILE_JUDGE_H

#include "kernels.h"

enum {
    TACTILE_MISSING_LEVEL = -32768, /* a level that was not read: the channel's last one counts again */
    TACTILE_ONE = 32768,            /* a feature of 1 */
    TACTILE_ANGLES = 4096,          /* steps of a proportion */
    TACTILE_CHANCES = 768,          /* sixty-fourths of a logit: what lies further behind has no probability */
    TACTILE_MOST_MATERIALS = 64,
    TACTILE_MOST_WINDOWS = 64,      /* of a scale */
    TACTILE_MOST_SCALES = 2,
    TACTILE_MOST_EDGES = 2 * TACTILE_MOST_SCALES * TACTILE_MOST_WINDOWS
};

/* The windows of one width, and how the mean of their features is weighed; M materials, F features. */
typedef struct {
    int32_t width;             /* readings of a window */
    const uint16_t *shares;    /* (dilations): the proportions of each */
    int32_t triangles;         /* features of levels, behind the proportions */
    const uint16_t *begins;    /* (triangles + 1): where each one's terms begin */
    const uint16_t *inputs;    /* of each term: statistic · channels + channel */
    const int16_t *factors;    /* of each term */
    const uint32_t *phases;    /* (triangles) */
    const int16_t *weights;    /* (F, M) */
    int32_t shift;             /* a weighed mean has so many bits more than a score */
    const int64_t *offsets;    /* (M): added to a weighed mean, gives z */
    const int64_t *halves;     /* (M): less these, z gives a score */
    const int32_t *background; /* (M, M), symmetric: H, in 2^-background_shift of a score's 2^-16 */
    int32_t background_shift;
} tactile_scale;

/* A touch of `least` readings or more is judged by the first `scales` scales. */
typedef struct {
    int32_t least, scales;
    int32_t detects;                             /* whether a new material would be noticed */
    int32_t weights[TACTILE_MOST_SCALES];        /* of scores, to 2^-24 logits */
    int32_t distance_weights[TACTILE_MOST_SCALES];
    int32_t distance_shifts[TACTILE_MOST_SCALES]; /* weight · distance / 2^shift: in 2^-16 spreads */
    int64_t threshold;
} tactile_stage;

typedef struct {
    int32_t channels, capacity; /* readings that a touch can have: those of the longest that was learned */
    int32_t materials, stages_count, dilations;
    const tactile_bank *banks;
    const tactile_scale *scales;
    const tactile_stage *stages;
    const uint16_t *angles;  /* (TACTILE_ANGLES + 1): 2^15 · (2/pi) · asin(sqrt(proportion)) */
    const uint16_t *chances; /* (TACTILE_CHANCES): 65535 · exp(-i / 64) */
} tactile_memory;

typedef struct {
    int32_t readings;    /* that the answer rests on */
    int32_t material;    /* the likeliest; −1 where the touch is too short to say */
    int32_t known;       /* 1; 0: never felt; −1: cannot be told */
    int32_t probability; /* of 65535 */
    int64_t novelty;     /* above 0: never felt; 2^-16 spreads of what was learned */
    int64_t scores[TACTILE_MOST_MATERIALS]; /* 2^-24 logits, before a common constant */
} tactile_answer;

/* A touch, and what to judge it in. */
typedef struct {
    const tactile_memory *memory;
    int16_t *levels;    /* (channels, capacity) */
    int32_t *work;      /* (4, capacity) */
    int32_t *triangles; /* (most triangles of a scale) */
    int32_t *statistics; /* (4, channels) */
    int32_t readings, clipped; /* taken; of these, levels outside of ±2048 */
    int32_t edges[TACTILE_MOST_EDGES], before[TACTILE_MOST_EDGES];
    int32_t starts[TACTILE_MOST_SCALES][TACTILE_MOST_WINDOWS], windows[TACTILE_MOST_SCALES];
    int64_t sums[TACTILE_MOST_SCALES][TACTILE_MOST_MATERIALS];
} tactile_touch;

#ifdef __cplusplus
extern "C" {
#endif

/* Forget the touch before. */
void tactile_begin(tactile_touch *touch);

/* Take a reading, a level of each channel in ±2048. Returns 0 where there is no room for it: it is not taken. */
int tactile_push(tactile_touch *touch, const int16_t *reading);

/* Judge what was read until now. */
void tactile_judge(tactile_touch *touch, tactile_answer *answer);

/* The level of a value in the sensor's unit, of a channel that reads from low to high; halves go to even, as Python's.
 *
 * What lies outside of the range is the nearest within; NaN and infinity are TACTILE_MISSING_LEVEL.
 */
static inline int16_t tactile_level(float low, float high, float value)
{
    if (!(value - value == 0))
        return TACTILE_MISSING_LEVEL;
    const float half = (high - low) / 2, inside = value < low ? low : value > high ? high : value;
    const float image = (inside - low) / half - 1, steps = image * (float)TACTILE_LEVELS;
    const int32_t whole = (int32_t)steps, odd = whole % 2 != 0;
    const float rest = steps - (float)whole;
    return (int16_t)(whole + (rest > 0.5f || (rest == 0.5f && odd)) - (rest < -0.5f || (rest == -0.5f && odd)));
}

#ifdef __cplusplus
}
#endif

#endif
