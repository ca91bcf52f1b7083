/* What a touch is compared with kept ones by, in whole numbers; see matching/matcher.py and matching/kept_arrays.py. */
#ifndef SCROLL_TACTILE_MATCHING_H
#define SCROLL_TACTILE_MATCHING_H

#include <stdint.h>

enum {
    TACTILE_MISSING = 255,     /* the level of what was not read */
    TACTILE_QUARTERS = 4,      /* steps of a guess in one level */
    TACTILE_MOST_GUESS = 2048, /* a guess lies in ± so many steps */
    TACTILE_TABLE = 65536      /* entries, at 256 · level + other level */
};

/* sums (others): of a table's entries over the values of a touch, levels (values), beside others, (others, values). */
void tactile_sum_logs(const uint8_t *own, int64_t values, const uint8_t *others, int64_t count, const int16_t *table,
                      int64_t *sums);

/* Squared distances of rows of levels from guesses, over the places that both have.
 *
 * rows: (count, width). guesses: (guesses, width), in quarters of a level. known: (width), whether the guesses have a
 * place. sums: (count, guesses). seen: (count), how many places both have.
 */
void tactile_distances(const uint8_t *rows, int64_t count, int64_t width, const int16_t *guesses, int64_t number,
                       const uint8_t *known, int64_t *sums, int64_t *seen);

#endif
