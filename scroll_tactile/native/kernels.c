#include "kernels.h"

#include <stddef.h>
#include <string.h>

#include "wide.h"

/* Sum a kernel's channels at each reading. */
WIDE static void sum_channels(const int16_t *restrict levels, int32_t stride, int32_t readings,
                              const uint16_t *restrict channels, int32_t count, int32_t *restrict sums)
{
    const int16_t *one = levels + (ptrdiff_t)channels[0] * stride;
    int32_t i = 1;
    for (int32_t t = 0; t < readings; t++)
        sums[t] = one[t];
    for (; i + 3 < count; i += 4) {
        const int16_t *a = levels + (ptrdiff_t)channels[i] * stride, *b = levels + (ptrdiff_t)channels[i + 1] * stride;
        const int16_t *c = levels + (ptrdiff_t)channels[i + 2] * stride, *d = levels + (ptrdiff_t)channels[i + 3] * stride;
        for (int32_t t = 0; t < readings; t++)
            sums[t] += (int32_t)a[t] + b[t] + c[t] + d[t];
    }
    for (; i < count; i++) {
        one = levels + (ptrdiff_t)channels[i] * stride;
        for (int32_t t = 0; t < readings; t++)
            sums[t] += one[t];
    }
}

/* Three times the sums at the heavy taps, less the sums at all nine, which are added by doubling. */
WIDE static void convolve(const int32_t *restrict sums, int32_t readings, int32_t dilation, const uint8_t *heavy,
                          int32_t *restrict twos, int32_t *restrict fours, int32_t *restrict responses)
{
    const int32_t *first = sums + heavy[0] * dilation, *second = sums + heavy[1] * dilation;
    const int32_t *third = sums + heavy[2] * dilation, *last = sums + TACTILE_SPAN * dilation;
    const int32_t places = readings - TACTILE_SPAN * dilation;
    for (int32_t t = 0; t < readings - dilation; t++)
        twos[t] = sums[t] + sums[t + dilation];
    for (int32_t t = 0; t < readings - 3 * dilation; t++)
        fours[t] = twos[t] + twos[t + 2 * dilation];
    for (int32_t t = 0; t < places; t++)
        responses[t] = 3 * (first[t] + second[t] + third[t]) - fours[t] - fours[t + 4 * dilation] - last[t];
}

WIDE void tactile_exceeding(const int32_t *restrict values, int32_t threshold, const int32_t *restrict edges,
                            int32_t segments, int32_t *restrict before)
{
    int32_t found = 0;
    before[0] = 0;
    for (int32_t s = 0; s < segments; s++) {
        const int32_t *own = values + edges[s], count = edges[s + 1] - edges[s];
        for (int32_t t = 0; t < count; t++)
            found += own[t] > threshold;
        before[s + 1] = found;
    }
}

/* The greatest and the least weighted response of a group at each place; where none is above or below 0, no value. */
WIDE static void extremes(const int32_t *restrict responses, int32_t readings, int32_t places,
                          const uint8_t *restrict weights, int32_t *restrict most, int32_t *restrict least)
{
    memset(most, 0, (size_t)places * sizeof *most);
    memset(least, 0, (size_t)places * sizeof *least);
    for (int32_t member = 0; member < TACTILE_GROUP; member++) {
        const int32_t *own = responses + (ptrdiff_t)member * readings, weight = weights[member];
        for (int32_t t = 0; t < places; t++) {
            const int32_t value = own[t] * weight;
            most[t] = value > most[t] ? value : most[t];
            least[t] = value < least[t] ? value : least[t];
        }
    }
    for (int32_t t = 0; t < places; t++) {
        most[t] = most[t] ? most[t] : INT32_MAX;
        least[t] = least[t] ? least[t] : INT32_MAX;
    }
}

/* At how many places a weighted response is the best. */
WIDE static int32_t winning(const int32_t *restrict responses, int32_t weight, const int32_t *restrict best,
                            int32_t places)
{
    int32_t found = 0;
    for (int32_t t = 0; t < places; t++)
        found += responses[t] * weight == best[t];
    return found;
}

void tactile_respond(const tactile_bank *bank, int32_t kernel, const int16_t *levels, int32_t stride, int32_t readings,
                     int32_t *work, int32_t *responses)
{
    const int32_t begin = bank->begins[kernel], count = bank->begins[kernel + 1] - begin;
    sum_channels(levels, stride, readings, bank->channels + begin, count, work);
    convolve(work, readings, bank->dilation, bank->heavy + 3 * kernel, work + readings, work + 2 * readings, responses);
}

typedef struct {
    const tactile_bank *bank;
    const int16_t *levels;
    int32_t readings;
    int32_t held[TACTILE_GROUP]; /* the kernel whose responses lie in each of `responses`, or −1 */
    int32_t *work, *responses;
} state;

/* The responses of a kernel, in one of the places that a group's have; made unless they are there. */
static const int32_t *responses_of(state *at, int32_t kernel, int32_t slot)
{
    int32_t *responses = at->responses + (ptrdiff_t)slot * at->readings;
    if (at->held[slot] != kernel) {
        tactile_respond(at->bank, kernel, at->levels, at->readings, at->readings, at->work, responses);
        at->held[slot] = kernel;
    }
    return responses;
}

static void count_features(const tactile_bank *bank, const tactile_request *request, int32_t kernel,
                           const int32_t *responses, int32_t *counted, int32_t *before)
{
    for (int32_t feature = kernel; feature < request->features; feature += bank->kernels) {
        tactile_exceeding(responses, bank->thresholds[feature], request->edges, request->segments, before);
        for (int32_t w = 0; w < request->windows; w++)
            counted[(ptrdiff_t)w * request->features + feature] =
                before[request->spans[2 * w + 1]] - before[request->spans[2 * w]];
    }
}

static void compete(state *at, const tactile_request *request, int32_t group, int32_t *contests)
{
    const int32_t places = at->readings - TACTILE_SPAN * at->bank->dilation;
    const uint16_t *members = request->members + TACTILE_GROUP * group;
    const uint8_t *weights = request->weights + TACTILE_GROUP * group;
    int32_t *most = at->work, *least = at->work + at->readings; /* free between two convolutions */
    for (int32_t i = 0; i < TACTILE_GROUP; i++)
        responses_of(at, members[i], i);
    extremes(at->responses, at->readings, places, weights, most, least);
    for (int32_t i = 0; i < TACTILE_GROUP; i++) {
        const int32_t *own = at->responses + (ptrdiff_t)i * at->readings, place = TACTILE_GROUP * group + i;
        contests[place] = winning(own, weights[i], most, places);
        contests[TACTILE_GROUP * request->groups + place] = winning(own, weights[i], least, places);
    }
}

void tactile_count(const tactile_bank *bank, const int16_t *levels, int32_t readings, const tactile_request *request,
                   int32_t *counted, int32_t *contests, int32_t *work)
{
    state at = {bank, levels, readings, {-1, -1, -1, -1, -1, -1, -1, -1}, work, work + 3 * readings};
    int32_t *before = work + (TACTILE_GROUP + 3) * readings, group = 0;
    for (int32_t kernel = 0; kernel < bank->kernels && kernel < request->features; kernel++) {
        count_features(bank, request, kernel, responses_of(&at, kernel, kernel % TACTILE_GROUP), counted, before);
        /* The first groups are kernels in a row: their responses are here now. */
        if (kernel % TACTILE_GROUP == TACTILE_GROUP - 1 && group < request->groups)
            compete(&at, request, group++, contests);
    }
    while (group < request->groups)
        compete(&at, request, group++, contests);
}
