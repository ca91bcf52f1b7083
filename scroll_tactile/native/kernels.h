/* Counts of the default embedding's convolution kernels, in whole numbers, without an allocation: for a PC and a chip.
 *
 * A kernel sums some channels; its response at a place is 2 at three of nine taps and −1 at the six others, times these
 * sums. A feature is the number of places of a window at which a response exceeds a threshold. See
 * embeddings/convolution.py.
 */
#ifndef SCROLL_TACTILE_KERNELS_H
#define SCROLL_TACTILE_KERNELS_H

#include <stdint.h>

enum {
    TACTILE_TAPS = 9,
    TACTILE_SPAN = TACTILE_TAPS - 1, /* dilations from the first tap to the last */
    TACTILE_GROUP = 8,          /* kernels that compete */
    TACTILE_MOST_CHANNELS = 64, /* to a kernel */
    TACTILE_LEVELS = 2048,      /* levels lie in ± so many: with 64 channels a response stays below 2^21 */
    TACTILE_MOST_WEIGHT = 64    /* of a kernel that competes: its weighted responses stay below 2^27 */
};

/* The kernels of one dilation. */
typedef struct {
    int32_t kernels;           /* K */
    int32_t dilation;          /* readings between two taps */
    const uint8_t *heavy;      /* (K, 3): the taps of weight 2, ascending */
    const uint16_t *begins;    /* (K + 1): where each kernel's channels begin in `channels` */
    const uint16_t *channels;  /* the channels that each kernel sums */
    const int32_t *thresholds; /* (rounds, K): a response exceeds one that is greater */
} tactile_bank;

/* What is counted of one dilation.
 *
 * Places 0 … readings − TACTILE_SPAN · dilation − 1 are cut into segments by ascending edges; a window is some segments in a row.
 */
typedef struct {
    int32_t features;        /* F: of threshold 0 of each kernel, then of threshold 1 …; at most rounds · K */
    int32_t segments;        /* S, at least 1 where F is */
    const int32_t *edges;    /* (S + 1) */
    int32_t windows;         /* W */
    const int32_t *spans;    /* (W, 2): first segment, and the one behind the last */
    int32_t groups;          /* G */
    const uint16_t *members; /* (G, 8): the kernels of each group */
    const uint8_t *weights;  /* (G, 8): what makes their responses comparable */
} tactile_request;

/* How many int32_t `tactile_count` needs to work in. */
#define TACTILE_WORK(readings, segments) ((TACTILE_GROUP + 3) * (readings) + (segments) + 1)

#ifdef __cplusplus
extern "C" {
#endif

/* A kernel's responses: `readings` − TACTILE_SPAN · dilation of them, in as many places as there are readings.
 *
 * levels: of each channel `stride` readings, of which the first `readings` count. work: (3, readings).
 */
void tactile_respond(const tactile_bank *bank, int32_t kernel, const int16_t *levels, int32_t stride, int32_t readings,
                     int32_t *work, int32_t *responses);

/* before[s]: how many values of the segments before s exceed a threshold; `segments` + 1 of them. */
void tactile_exceeding(const int32_t *values, int32_t threshold, const int32_t *edges, int32_t segments, int32_t *before);

/* Count.
 *
 * levels: (C, readings). counted: (W, F). contests: (2, G, 8): at how many places each member of a group has the greatest
 * response above 0, and the least below 0; members that share a place both have it. work: see TACTILE_WORK.
 * readings must exceed TACTILE_SPAN · dilation. All arrays must be as described: nothing is checked here.
 */
void tactile_count(const tactile_bank *bank, const int16_t *levels, int32_t readings, const tactile_request *request,
                   int32_t *counted, int32_t *contests, int32_t *work);

#ifdef __cplusplus
}
#endif

#endif
