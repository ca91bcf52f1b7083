/* Judges the touches of a file, says how many answers differ from those in it, and counts the instructions of a touch.
 *
 * Words: the file, and how many touches to count; the others are judged. On a Cortex-M with QEMU's -icount shift=0, an
 * instruction is a nanosecond, and a tick of the system's timer 40 of them.
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "touch_memory.h"

enum { TICK = 40, TICKS = 1 << 24 };

#ifdef __arm__
static volatile uint32_t *const timer = (uint32_t *)0xE000E010; /* control, reload, current */

static void start_timer(void)
{
    timer[1] = TICKS - 1;
    timer[2] = 0;
    timer[0] = 5;
}

static int32_t ticks(void) { return (int32_t)timer[2]; }
#else
static void start_timer(void) {}

static int32_t ticks(void) { return 0; }
#endif

static int32_t since(int32_t begun) { return (begun - ticks()) & (TICKS - 1); }

int main(int count, char **words)
{
    FILE *file = count > 1 ? fopen(words[1], "rb") : NULL;
    const int limit = count > 2 ? atoi(words[2]) : 0;
    int touches = 0, differ = 0;
    int32_t readings;
    if (file == NULL)
        return puts("expected a file of touches"), 2;
    for (; (!limit || touches < limit) && fread(&readings, sizeof readings, 1, file) == 1; touches++) {
        tactile_answer answer;
        int32_t heads[4], pushing = 0, begun;
        int64_t novelty, scores[TOUCH_MEMORY_MATERIALS];
        start_timer();
        touch_memory_begin();
        for (int32_t t = 0; t < readings; t++) {
            int16_t reading[TOUCH_MEMORY_CHANNELS];
            if (fread(reading, sizeof reading, 1, file) != 1)
                return puts("the file ends within a touch"), 2;
            begun = ticks();
            touch_memory_push(reading);
            pushing += since(begun);
        }
        begun = ticks();
        touch_memory_answer(&answer);
        const int32_t judging = since(begun);
        if (fread(heads, sizeof heads, 1, file) != 1 || fread(&novelty, sizeof novelty, 1, file) != 1 ||
            fread(scores, sizeof scores, 1, file) != 1)
            return puts("the file ends within an answer"), 2;
        differ += heads[0] != answer.material || heads[1] != answer.known || heads[2] != answer.probability ||
                  heads[3] != answer.readings || novelty != answer.novelty ||
                  memcmp(scores, answer.scores, sizeof scores) != 0;
        if (limit)
            printf("%ld %ld %ld\n", (long)readings, (long)TICK * pushing, (long)TICK * judging);
    }
    printf("%d touches, %d differ\n", touches, differ);
    fclose(file);
    return differ > 0;
}
