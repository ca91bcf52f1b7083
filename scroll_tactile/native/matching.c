#include "matching.h"

#include "wide.h"

void tactile_sum_logs(const uint8_t *own, int64_t values, const uint8_t *others, int64_t count, const int16_t *table,
                      int64_t *sums)
{
    for (int64_t i = 0; i < count; i++) {
        const uint8_t *other = others + i * values;
        int64_t sum = 0;
        for (int64_t v = 0; v < values; v++)
            sum += table[(int32_t)own[v] << 8 | other[v]];
        sums[i] = sum;
    }
}

enum { AT_ONCE = 128 }; /* squares below (4 · 254 + 2048)² are added in 32 bits */

WIDE static int64_t distance(const uint8_t *restrict row, const int16_t *restrict guess, const uint8_t *restrict known,
                             int64_t width)
{
    int64_t sum = 0;
    for (int64_t first = 0; first < width; first += AT_ONCE) {
        const int32_t count = (int32_t)(width - first < AT_ONCE ? width - first : AT_ONCE);
        int32_t part = 0;
        for (int32_t i = 0; i < count; i++) {
            const int16_t both = (int16_t)-(int16_t)((row[first + i] != TACTILE_MISSING) & (known[first + i] != 0));
            const int16_t away = (int16_t)((TACTILE_QUARTERS * row[first + i] - guess[first + i]) & both);
            part += (int32_t)away * away;
        }
        sum += part;
    }
    return sum;
}

WIDE static int64_t seen_of(const uint8_t *restrict row, const uint8_t *restrict known, int64_t width)
{
    int64_t seen = 0;
    for (int64_t i = 0; i < width; i++)
        seen += (row[i] != TACTILE_MISSING) & (known[i] != 0);
    return seen;
}

void tactile_distances(const uint8_t *rows, int64_t count, int64_t width, const int16_t *guesses, int64_t number,
                       const uint8_t *known, int64_t *sums, int64_t *seen)
{
    for (int64_t i = 0; i < count; i++) {
        for (int64_t guess = 0; guess < number; guess++)
            sums[i * number + guess] = distance(rows + i * width, guesses + guess * width, known, width);
        seen[i] = seen_of(rows + i * width, known, width);
    }
}
