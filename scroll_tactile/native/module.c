/* What is compiled, for Python: every array is a buffer, and nothing is read or written outside of one. */
#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include "kernels.h"
#include "matching.h"

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

/* Whether a length is so many times another. */
static int of(Py_ssize_t length, Py_ssize_t count, Py_ssize_t each)
{
    return each == 0 || count <= PY_SSIZE_T_MAX / each ? length == count * each : 0;
}

static PyObject *done(int well)
{
    if (!well)
        return NULL;
    Py_RETURN_NONE;
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
    if (!require(dilation >= 1 && dilation <= INT32_MAX / TACTILE_SPAN && readings > TACTILE_SPAN * dilation, "readings for a dilation") ||
        !require(n[LEVELS] > 0 && n[LEVELS] % readings == 0 && n[LEVELS] / readings <= 65536, "levels (C, readings)") ||
        !require(n[HEAVY] > 0 && n[HEAVY] <= 65535 && n[BEGINS] == n[HEAVY] + 1, "a bank of kernels") ||
        !require(features >= 0 && features <= n[THRESHOLDS], "a threshold to each feature") ||
        !require(n[EDGES] >= 1 && n[EDGES] <= readings && n[WEIGHTS] == n[MEMBERS], "edges, and a weight to each member") ||
        !require(n[COUNTED] == n[SPANS] * features && n[CONTESTS] == 2 * TACTILE_GROUP * n[MEMBERS], "room for the counts") ||
        !sound_levels(with[LEVELS].buf, n[LEVELS]) ||
        !sound_bank(&bank, n[CHANNELS], (int32_t)(n[LEVELS] / readings)) ||
        !sound_request(&request, &bank, readings - TACTILE_SPAN * dilation))
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
    return done(!failed);
}

static PyObject *sum_logs(PyObject *module, PyObject *args)
{
    (void)module;
    Py_buffer own, others, table, sums;
    if (!PyArg_ParseTuple(args, "y*y*y*w*", &own, &others, &table, &sums))
        return NULL;
    const Py_ssize_t count = sums.len / 8;
    const int sound = require(table.len == 2 * TACTILE_TABLE, "a table of 65536 entries") &&
                      require(sums.len % 8 == 0 && of(others.len, count, own.len), "a sum to each other touch");
    if (sound) {
        Py_BEGIN_ALLOW_THREADS;
        tactile_sum_logs(own.buf, own.len, others.buf, count, table.buf, sums.buf);
        Py_END_ALLOW_THREADS;
    }
    PyBuffer_Release(&own);
    PyBuffer_Release(&others);
    PyBuffer_Release(&table);
    PyBuffer_Release(&sums);
    return done(sound);
}

static int sound_guesses(const int16_t *guesses, Py_ssize_t count)
{
    int outside = 0;
    for (Py_ssize_t i = 0; i < count; i++)
        outside |= guesses[i] > TACTILE_MOST_GUESS || guesses[i] < -TACTILE_MOST_GUESS;
    return require(!outside, "guesses in ±2048");
}

static PyObject *distances(PyObject *module, PyObject *args)
{
    (void)module;
    Py_buffer rows, guesses, known, sums, seen;
    if (!PyArg_ParseTuple(args, "y*y*y*w*w*", &rows, &guesses, &known, &sums, &seen))
        return NULL;
    const Py_ssize_t count = seen.len / 8, number = count ? sums.len / 8 / count : 0;
    const int sound = require(seen.len % 8 == 0 && of(rows.len, count, known.len), "a count to each row") &&
                      require(sums.len % 8 == 0 && of(sums.len / 8, count, number), "a sum to each row and guess") &&
                      require(guesses.len % 2 == 0 && of(guesses.len / 2, number, known.len), "guesses of a row's width") &&
                      sound_guesses(guesses.buf, guesses.len / 2);
    if (sound) {
        Py_BEGIN_ALLOW_THREADS;
        tactile_distances(rows.buf, count, known.len, guesses.buf, number, known.buf, sums.buf, seen.buf);
        Py_END_ALLOW_THREADS;
    }
    PyBuffer_Release(&rows);
    PyBuffer_Release(&guesses);
    PyBuffer_Release(&known);
    PyBuffer_Release(&sums);
    PyBuffer_Release(&seen);
    return done(sound);
}

static PyMethodDef methods[] = {
    {"sum_logs", sum_logs, METH_VARARGS,
     "sum_logs(own, others, table, sums): see matching.h. The last is written. Raises ValueError for what does not fit."},
    {"distances", distances, METH_VARARGS,
     "distances(rows, guesses, known, sums, seen): see matching.h. The last two are written. Raises ValueError likewise."},
    {"count", count, METH_VARARGS,
     "count(readings, dilation, features, levels, heavy, begins, channels, thresholds, edges, spans, members, weights,\n"
     "counted, contests): see kernels.h. The last two are written. Raises ValueError for what does not fit together."},
    {NULL, NULL, 0, NULL}};

static struct PyModuleDef definition = {PyModuleDef_HEAD_INIT, "_kernels", "What is counted and compared in C.", 0, methods,
                                        NULL, NULL, NULL, NULL};

PyMODINIT_FUNC PyInit__kernels(void) { return PyModule_Create(&definition); }
