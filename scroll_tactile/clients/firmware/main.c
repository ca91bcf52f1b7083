/* An example, and a check: judges the touches of a file, and says how many answers differ from those in it.
 *
 * The file is touches.bin, or what the command line names; it is little-endian, as the machine has to be.
 */
#include <stdio.h>
#include <string.h>

#include "touch_memory.h"

static int same(const tactile_answer *answer, FILE *file)
{
    int32_t heads[4];
    int64_t novelty, scores[TOUCH_MEMORY_MATERIALS];
    if (fread(heads, sizeof heads, 1, file) != 1 || fread(&novelty, sizeof novelty, 1, file) != 1 ||
        fread(scores, sizeof scores, 1, file) != 1)
        return 0;
    return heads[0] == answer->material && heads[1] == answer->known && heads[2] == answer->probability &&
           heads[3] == answer->readings && novelty == answer->novelty && !memcmp(scores, answer->scores, sizeof scores);
}

int main(int count, char **words)
{
    FILE *file = fopen(count > 1 ? words[1] : "touches.bin", "rb");
    int touches = 0, differ = 0;
    int32_t readings;
    if (file == NULL)
        return puts("expected a file of touches: touches.bin, or one that is named"), 2;
    for (; fread(&readings, sizeof readings, 1, file) == 1; touches++) {
        tactile_answer answer;
        touch_memory_begin();
        for (int32_t t = 0; t < readings; t++) {
            int16_t reading[TOUCH_MEMORY_CHANNELS];
            if (fread(reading, sizeof reading, 1, file) != 1)
                return puts("the file ends within a touch"), 2;
            touch_memory_push(reading);
        }
        touch_memory_answer(&answer);
        if (touches < 5)
            printf("%s, %d of 65535%s\n", answer.material < 0 ? "too short" : touch_memory_names[answer.material],
                   (int)answer.probability, answer.known == 0 ? ", never felt" : "");
        differ += !same(&answer, file);
    }
    printf("%d touches, %d answers differ\n", touches, differ);
    fclose(file);
    return differ > 0;
}
