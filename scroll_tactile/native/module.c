/* What is compiled, for Python: every array is a buffer, and nothing is read or written outside of one. */
#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include "kernels.h"

/* An argument's items of a size; −1 with ValueError where the buffer is no whole number of them. */
static Py_ssize_t items(const Py_buffer *buffer, size_t size, const char *name)
{
    if (buffer->len % (Py_ssize_t)size == 0 && buffer->len / (Py_ssize_t)size <= INT32_MAX)
        return buffer->len / (Py_ssize_t)size;
    PyErr_Format(PyExc_ValueError, "expected %s of items of %zu bytes; came %zd bytes", name, size, buffer->len);
    return -1;
}

static int require(int holds, const char *what)
{
    if (!holds)
        PyErr_Format(PyExc_ValueError, "expected %s", what);
    return holds;
}

static int sound_bank(const tactile_bank *bank, Py_ssize_t listed, int32_t channels)
{
    for (int32_t k = 0; k < bank->kernels; k++) {
        const int32_t summed = bank->begins[k + 1] - bank->begins[k];
        if (!require(summed >= 1 && summed <= TACTILE_MOST_CHANNELS, "1 to 64 channels to a kernel"))
            return 0;
        for (int i = 0; i < 3; i++)
            if (!require(bank->heavy[3 * k + i] < TACTILE_TAPS, "heavy taps below 9"))
                return 0;
    }
    if (!require(bank->begins[0] == 0 && bank->begins[bank->kernels] == listed, "as many channels as `begins` says"))
        return 0;
    for (Py_ssize_t i = 0; i < listed; i++)
        if (!require(bank->channels[i] < channels, "channels of the image"))
            return 0;
    return 1;
}

static int sound_request(const tactile_request *request, const tactile_bank *bank, int32_t places)
{
    for (int32_t s = 0; s < request->segments; s++)
        if (!require(request->edges[s] <= request->edges[s + 1], "ascending edges"))
            return 0;
    if (!require(request->edges[0] >= 0 && request->edges[request->segments] <= places, "edges within the places"))
        return 0;
    for (int32_t w = 0; w < request->windows; w++)
        if (!require(0 <= request->spans[2 * w] && request->spans[2 * w] <= request->spans[2 * w + 1] &&
                         request->spans[2 * w + 1] <= request->segments,
                     "spans of segments"))
            return 0;
    for (int32_t i = 0; i < request->groups * TACTILE_GROUP; i++)
        if (!require(request->members[i] < bank->kernels && request->weights[i] <= TACTILE_MOST_WEIGHT,
                     "members among the kernels, of weights to 64"))
            return 0;
    return 1;
}

static int sound_levels(const int16_t *levels, Py_ssize_t count)
{
    int outside = 0;
    for (Py_ssize_t i = 0; i < count; i++)
        outside |= levels[i] > TACTILE_LEVELS || levels[i] < -TACTILE_LEVELS;
    return require(!outside, "levels in ±2048");
}

enum { LEVELS, HEAVY, BEGINS, CHANNELS, THRESHOLDS, EDGES, SPANS, MEMBERS, WEIGHTS, COUNTED, CONTESTS, BUFFERS };

static int count_into(Py_buffer *with, int readings, int dilation, int features)
{
    static const struct {
        const char *name;
        size_t size;
    } kinds[BUFFERS] = {{"levels", 2}, {"heavy", 3},   {"begins", 2},  {"channels", 2}, {"thresholds", 4}, {"edges", 4},
                        {"spans", 8},  {"members", 16}, {"weights", 8}, {"counted", 4},  {"contests", 4}};
    Py_ssize_t n[BUFFERS];
    for (int i = 0; i < BUFFERS; i++)
        if ((n[i] = items(&with[i], kinds[i].size, kinds[i].name)) < 0)
            return -1;
    const tactile_bank bank = {(int32_t)n[HEAVY],     dilation,           with[HEAVY].buf,
                               with[BEGINS].buf,      with[CHANNELS].buf, with[THRESHOLDS].buf};
    const tactile_request request = {features,           (int32_t)n[EDGES] - 1, with[EDGES].buf,   (int32_t)n[SPANS],
                                     with[SPANS].buf, (int32_t)n[MEMBERS],   with[MEMBERS].buf, with[WEIGHTS].buf};
    if (!require(dilation >= 1 && dilation <= INT32_MAX / 8 && readings > 8 * dilation, "readings for a dilation") ||
        !require(n[LEVELS] > 0 && n[LEVELS] % readings == 0 && n[LEVELS] / readings <= 65536, "levels (C, readings)") ||
        !require(n[HEAVY] > 0 && n[HEAVY] <= 65535 && n[BEGINS] == n[HEAVY] + 1, "a bank of kernels") ||
        !require(features >= 0 && features <= n[THRESHOLDS], "a threshold to each feature") ||
        !require(n[EDGES] >= 1 && n[EDGES] <= readings && n[WEIGHTS] == n[MEMBERS], "edges, and a weight to each member") ||
        !require(n[COUNTED] == n[SPANS] * features && n[CONTESTS] == 16 * n[MEMBERS], "room for the counts") ||
        !sound_levels(with[LEVELS].buf, n[LEVELS]) ||
        !sound_bank(&bank, n[CHANNELS], (int32_t)(n[LEVELS] / readings)) ||
        !sound_request(&request, &bank, readings - 8 * dilation))
        return -1;
    int32_t *work = PyMem_RawMalloc(TACTILE_WORK((size_t)readings, (size_t)request.segments) * sizeof *work);
    if (work == NULL) {
        PyErr_NoMemory();
        return -1;
    }
    Py_BEGIN_ALLOW_THREADS;
    tactile_count(&bank, with[LEVELS].buf, readings, &request, with[COUNTED].buf, with[CONTESTS].buf, work);
    Py_END_ALLOW_THREADS;
    PyMem_RawFree(work);
    return 0;
}

static PyObject *count(PyObject *module, PyObject *args)
{
    (void)module;
    Py_buffer with[BUFFERS] = {{0}};
    int readings, dilation, features;
    if (!PyArg_ParseTuple(args, "iiiy*y*y*y*y*y*y*y*y*w*w*", &readings, &dilation, &features, &with[LEVELS],
                          &with[HEAVY], &with[BEGINS], &with[CHANNELS], &with[THRESHOLDS], &with[EDGES], &with[SPANS],
                          &with[MEMBERS], &with[WEIGHTS], &with[COUNTED], &with[CONTESTS]))
        return NULL;
    const int failed = count_into(with, readings, dilation, features);
    for (int i = 0; i < BUFFERS; i++)
        PyBuffer_Release(&with[i]);
    if (failed)
        return NULL;
    Py_RETURN_NONE;
}

/* Sums of a table's entries at 256 · own + other, for each of some others. */
static void sum_entries(const uint8_t *own, Py_ssize_t values, const uint8_t *others, Py_ssize_t count,
                        const int16_t *table, int64_t *sums)
{
    for (Py_ssize_t i = 0; i < count; i++) {
        const uint8_t *other = others + i * values;
        int64_t sum = 0;
        for (Py_ssize_t v = 0; v < values; v++)
            sum += table[(size_t)own[v] << 8 | other[v]];
        sums[i] = sum;
    }
}

static PyObject *sum_logs(PyObject *module, PyObject *args)
{
    (void)module;
    Py_buffer own, others, table, sums;
    if (!PyArg_ParseTuple(args, "y*y*y*w*", &own, &others, &table, &sums))
        return NULL;
    const Py_ssize_t count = sums.len / (Py_ssize_t)sizeof(int64_t);
    const int sound = require(table.len == 65536 * (Py_ssize_t)sizeof(int16_t), "a table of 65536 entries") &&
                      require(sums.len % (Py_ssize_t)sizeof(int64_t) == 0 && (own.len == 0 || count <= others.len / own.len) &&
                                  others.len == count * own.len,
                              "as many values of each other touch, and a sum for each");
    if (sound) {
        Py_BEGIN_ALLOW_THREADS;
        sum_entries(own.buf, own.len, others.buf, count, table.buf, sums.buf);
        Py_END_ALLOW_THREADS;
    }
    PyBuffer_Release(&own);
    PyBuffer_Release(&others);
    PyBuffer_Release(&table);
    PyBuffer_Release(&sums);
    if (!sound)
        return NULL;
    Py_RETURN_NONE;
}

static PyMethodDef methods[] = {
    {"sum_logs", sum_logs, METH_VARARGS,
     "sum_logs(own, others, table, sums): the sums of a table, int16 of 256 · own + other, over the values, uint8, of a\n"
     "touch and of others, int64, one to each. Raises ValueError for what does not fit together."},
    {"count", count, METH_VARARGS,
     "count(readings, dilation, features, levels, heavy, begins, channels, thresholds, edges, spans, members, weights,\n"
     "counted, contests): see kernels.h. The last two are written. Raises ValueError for what does not fit together."},
    {NULL, NULL, 0, NULL}};

static struct PyModuleDef definition = {PyModuleDef_HEAD_INIT, "_kernels", "The kernels' counts in C.", 0, methods,
                                        NULL, NULL, NULL, NULL};

PyMODINIT_FUNC PyInit__kernels(void) { return PyModule_Create(&definition); }
