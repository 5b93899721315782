/* Forecasts of many people, each by a decoder of their own, without leaving the processor's cache.

   One person's decoder is read again for each of the frames of a forecast, so the people take turns
   and their weights stay close to the core; what everybody shares (encoder, base) is read once for
   several windows. Python sees one function, which releases the interpreter's lock. */
#define PY_SSIZE_T_CLEAN
#include <Python.h>
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#if !defined(__x86_64__) || !defined(__GNUC__)
#error "there is no kernel for this kind of processor or compiler: torch does its work"
#endif
#include <immintrin.h>

#include "shape.h"

#include "lanes_avx2.h"
#include "layers.h"

#include "lanes_avx512.h"
#include "layers.h"

#include "window.h"
#include "body.h"

#define HEADER 64
#define MAGIC 0x4b494e45
#define SNAP 0.01f
#define LISTS 3 /* decoders, gates, corrections */

/* What the matrices of a decoder, or of the encoder, are kept in. */
enum { FLOAT32, FLOAT16, BFLOAT16, KINDS };

typedef struct {
    const char *name;
    void (*encode[KINDS])(const Shape *, const char *, int, const double *, Encoded *, int); /* not FLOAT16 */
    void (*decode[KINDS])(const Shape *, const char *, const Encoded *const *, float *const *, int);
    float (*distance)(const float *, const float *, int, int, int, float *);
    void (*recall)(const float *, const float *, int, float *);
    void (*correct)(const float *, const float *, const float *, float *, int);
    float (*read)(const float *, size_t, int);
    float (*read_half)(const uint16_t *, size_t, int);
    float (*read_brief)(const uint16_t *, size_t, int);
    float (*calculate)(int);
    const int *lanes;
} Processor;

static const Processor PROCESSORS[] = {
    {"avx512", {encode_avx512_full, NULL, encode_avx512_brief},
     {decode_avx512_full, decode_avx512_half, decode_avx512_brief}, distance_avx512, recall_avx512,
     correct_avx512, read_avx512, read_half_avx512, read_brief_avx512, calculate_avx512, &lanes_avx512},
    {"avx2", {encode_avx2_full, NULL, encode_avx2_brief}, {decode_avx2_full, decode_avx2_half, decode_avx2_brief},
     distance_avx2, recall_avx2, correct_avx2, read_avx2, read_half_avx2, read_brief_avx2, calculate_avx2, &lanes_avx2},
};
enum { KNOWN = sizeof PROCESSORS / sizeof *PROCESSORS };

static int is_here(int processor) {
    __builtin_cpu_init();
    const int narrow =
        __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("f16c");
    if (processor) return narrow;
    return narrow && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
           __builtin_cpu_supports("avx512vl");
}

/* A call: borrowed buffers, and room for what it works out. */
typedef struct {
    const Processor *processor;
    const Shape *shape;
    const char *encoder, *base;
    const char **decoders; /* of each window; NULL: the base alone */
    const float **gates;   /* of each window; NULL: everything is familiar */
    const float **corrections; /* of each window, on the points of its gate; NULL: none */
    const double *windows;
    float *displacement, *share, *fastest;
    Encoded *encoded;
    float *own;
    float *apart;   /* squared distances of a window to the points of its gate */
    float *amounts; /* MAX_RANK for each window, of its correction */
    int count;
} Call;

static int kind_of(const char *block) { return ((const int32_t *)block)[1]; }

static int is_folded(const char *encoder) { return ((const int32_t *)encoder)[2]; }

static void roll_out(const Call *call, const char *decoder, const Encoded **encoded, float **out, int count) {
    call->processor->decode[kind_of(decoder)](call->shape, decoder + HEADER, encoded, out, count);
}

/* How familiar a window is, 0 to 1; see models/familiarity.py. */
static float weigh(const Call *call, int row) {
    if (!call->decoders[row]) return 0.0f;
    const float *gate = call->gates[row];
    if (!gate) return 1.0f;
    const float *correction = call->corrections[row];
    const float distance = call->processor->distance(
        gate + 16, call->encoded[row].z, call->shape->z, (int)gate[0], (int)gate[1], correction ? call->apart : NULL);
    if (correction) call->processor->recall(correction, call->apart, (int)gate[0], call->amounts + row * MAX_RANK);
    float share = 1.0f / (1.0f + expf((distance - gate[2]) / gate[3]));
    share = (share - SNAP) / (1 - 2 * SNAP);
    return share < 0.0f ? 0.0f : share > 1.0f ? 1.0f : share;
}

static void mix(float *out, const float *own, float share, int size) {
    for (int i = 0; i < size; i++) {
        const float apart = own[i] - out[i];
        out[i] = share < 0.5f ? out[i] + share * apart : own[i] - (1.0f - share) * apart;
    }
}

/* From the net's frame and units back to metres in the frame of the window. */
static void turn_back(const Shape *s, const Encoded *encoded, float *out) {
    for (int i = 0; i < 3 * s->horizon * s->joints; i += 3) {
        const float x = out[i] * s->scales[0], z = out[i + 2] * s->scales[0];
        out[i] = encoded->cosine * x - encoded->sine * z;
        out[i + 1] *= s->scales[0];
        out[i + 2] = encoded->sine * x + encoded->cosine * z;
    }
}

/* The largest squared step of any joint, metres; not a number if a coordinate is none. */
static float find_fastest_step(const Shape *s, const float *displacement) {
    const int pose = 3 * s->joints;
    float most = 0.0f;
    for (int i = 0; i < s->horizon * pose; i += 3) {
        float squared = 0.0f;
        for (int axis = 0; axis < 3; axis++) {
            const float step = displacement[i + axis] - (i < pose ? 0.0f : displacement[i - pose + axis]);
            squared += step * step;
        }
        if (!(squared <= most)) most = squared;
        if (most != most) break;
    }
    return most;
}

/* Rows of one decoder go together; `size` is the length of a forecast. */
static void run(Call *call, const Encoded **encoded, float **out, char *done) {
    const Shape *s = call->shape;
    const int size = 3 * s->horizon * s->joints;
    int count = 0;
    call->processor->encode[kind_of(call->encoder)](
        s, call->encoder + HEADER, is_folded(call->encoder), call->windows, call->encoded, call->count);
    for (int row = 0; row < call->count; row++) {
        call->share[row] = weigh(call, row);
        done[row] = !(call->share[row] != 0.0f);
        if (!(call->share[row] < 1.0f) && !call->corrections[row]) continue;
        encoded[count] = call->encoded + row, out[count++] = call->displacement + (size_t)row * size;
    }
    if (count) roll_out(call, call->base, encoded, out, count);
    for (int row = 0; row < call->count; row++) {
        if (done[row]) continue;
        count = 0;
        for (int other = row; other < call->count; other++) {
            if (done[other] || call->decoders[other] != call->decoders[row]) continue;
            done[other] = 1;
            encoded[count] = call->encoded + other, out[count++] = call->own + (size_t)other * size;
        }
        roll_out(call, call->decoders[row], encoded, out, count);
    }
    for (int row = 0; row < call->count; row++) {
        float *answer = call->displacement + (size_t)row * size;
        const float share = call->share[row], *correction = call->corrections[row];
        if (correction && share != 0.0f)
            call->processor->correct(
                correction, call->amounts + row * MAX_RANK, answer, call->own + (size_t)row * size, size);
        if (!(share < 1.0f)) memcpy(answer, call->own + (size_t)row * size, size * sizeof(float));
        else if (share > 0.0f) mix(answer, call->own + (size_t)row * size, share, size);
        turn_back(s, call->encoded + row, answer);
        call->fastest[row] = find_fastest_step(s, answer);
    }
}

/* The size of a decoder's weights in bytes, 0 for a kind that there is not. */
static size_t measure_decoder(const Shape *s, int kind, const char *block) {
    Decoder_avx2_full full;
    Decoder_avx2_half half;
    Decoder_avx2_brief brief;
    if (kind == FLOAT32) return find_decoder_avx2_full(&full, s, block);
    if (kind == FLOAT16) return find_decoder_avx2_half(&half, s, block);
    return kind == BFLOAT16 ? find_decoder_avx2_brief(&brief, s, block) : 0;
}

static int check_decoder(const Shape *s, const Py_buffer *view) {
    if (view->len >= HEADER && *(const int32_t *)view->buf == MAGIC) {
        const size_t size = measure_decoder(s, kind_of(view->buf), (const char *)view->buf + HEADER);
        if (size && (size_t)view->len == HEADER + size) return 0;
    }
    PyErr_SetString(PyExc_ValueError, "not a decoder of this shape");
    return -1;
}

static int check_gate(const Shape *s, const Py_buffer *view) {
    const float *gate = view->buf;
    if (view->len >= HEADER && gate[0] >= 1 && gate[0] <= TILE && gate[1] >= 1 && gate[1] <= MAX_POINTS) {
        const int directions = (int)gate[0];
        const size_t size = padded(s->z, 16) + (size_t)s->z * padded(directions, 16) +
                            (size_t)padded((int)gate[1], 16) * directions;
        if ((size_t)view->len == HEADER + size * sizeof(float)) return 0;
    }
    PyErr_SetString(PyExc_ValueError, "not a gate of this shape");
    return -1;
}

static int check_correction(const Shape *s, const Py_buffer *view) {
    const float *correction = view->buf;
    if (view->len >= HEADER && correction[0] >= 1 && correction[0] <= MAX_RANK && correction[1] >= 1 &&
        correction[1] <= MAX_POINTS) {
        const size_t rank = padded((int)correction[0], 16);
        const size_t size = rank * (size_t)correction[1] + rank * padded(3 * s->horizon * s->joints, 16);
        if ((size_t)view->len == HEADER + size * sizeof(uint16_t)) return 0;
    }
    PyErr_SetString(PyExc_ValueError, "not a correction of this shape");
    return -1;
}

/* Whether every correction stands on the points of its window's gate. */
static int check_pairs(const Call *call) {
    for (int row = 0; row < call->count; row++) {
        const float *gate = call->gates[row], *correction = call->corrections[row];
        if (!correction || (call->decoders[row] && gate && gate[1] == correction[1])) continue;
        PyErr_SetString(PyExc_ValueError, "a correction without the gate that it stands on");
        return -1;
    }
    return 0;
}

static int is_joint(const Shape *s, int joint) { return joint >= 0 && joint < s->joints; }

/* Whether the tree lists joints of the skeleton, parents first. */
static int is_tree(const Shape *s) {
    for (int i = 0; i < s->joints; i++) {
        const int *parent = s->parent + i, *depth = s->depth + i;
        if (!is_joint(s, s->order[i]) || *parent < 0 || *parent > (i ? i - 1 : 0)) return 0;
        if (*depth != (i ? s->depth[*parent] + 1 : 0)) return 0;
    }
    return is_joint(s, s->hip) && is_joint(s, s->left_hip) && is_joint(s, s->right_hip) &&
           is_joint(s, s->left_shoulder) && is_joint(s, s->right_shoulder);
}

static int check_shape(const Py_buffer *view) {
    const Shape *s = view->buf;
    const char *problem = NULL;
    if (view->len != sizeof(Shape)) problem = "a shape has another size";
    else if (s->observe < 2 || s->observe > MAX_OBSERVE || s->heading_frames < 1 || s->heading_frames > s->observe ||
             s->joints < 1 || s->joints > MAX_JOINTS || s->horizon < 1)
        problem = "windows or skeletons of this size have no kernel";
    else if (s->hidden < 1 || s->state < 1 || s->token < 1 || s->spl < 1 || s->z < 1 || s->c < 1 ||
             s->heads < 1 || s->decoder_heads < 1 || s->hidden % TILE || s->hidden > MAX_HIDDEN || s->state % TILE || s->state > MAX_HIDDEN ||
             s->token % TILE || s->token > MAX_TOKEN || s->spl % 16 || s->spl > MAX_SPL || s->z > MAX_Z ||
             s->c > MAX_C || s->heads > MAX_HEADS || s->decoder_heads > MAX_HEADS ||
             s->hidden % (16 * s->heads) || s->token % (16 * s->decoder_heads))
        problem = "nets of this size have no kernel";
    else if (!is_tree(s))
        problem = "this kinematic tree has no kernel";
    if (problem) PyErr_SetString(PyExc_ValueError, problem);
    return problem ? -1 : 0;
}

/* The size of an encoder's weights in bytes, 0 for a kind that there is not. */
static size_t measure_encoder(const Shape *s, int kind, int is_folded, const char *block) {
    Encoder_avx2_full full;
    Encoder_avx2_brief brief;
    if (kind == FLOAT32) return find_encoder_avx2_full(&full, s, block, is_folded);
    return kind == BFLOAT16 ? find_encoder_avx2_brief(&brief, s, block, is_folded) : 0;
}

static int check_encoder(const Shape *s, const Py_buffer *view) {
    if (view->len >= HEADER && *(const int32_t *)view->buf == MAGIC) {
        const char *block = (const char *)view->buf + HEADER;
        const size_t size = measure_encoder(s, kind_of(view->buf), is_folded(view->buf), block);
        if (size && (size_t)view->len == HEADER + size) return 0;
    }
    PyErr_SetString(PyExc_ValueError, "not an encoder of this shape");
    return -1;
}

/* Borrow the buffers of a list, None for NULL; gives how many views were taken, -1 on an error. */
static Py_ssize_t borrow(PyObject *list, Py_ssize_t count, Py_buffer *views, const void **out,
                         const Shape *s, int (*check)(const Shape *, const Py_buffer *)) {
    Py_ssize_t taken = 0;
    for (Py_ssize_t i = 0; i < count; i++) {
        PyObject *item = PyList_GET_ITEM(list, i);
        out[i] = NULL;
        if (item == Py_None) continue;
        if (PyObject_GetBuffer(item, &views[taken], PyBUF_SIMPLE) < 0) goto failed;
        taken++;
        if (check(s, &views[taken - 1]) < 0) goto failed;
        out[i] = views[taken - 1].buf;
    }
    return taken;
failed:
    while (taken) PyBuffer_Release(&views[--taken]);
    return -1;
}

static int check_arrays(const Call *call, const Py_buffer *given, const Py_buffer *made, const Py_buffer *share,
                        const Py_buffer *fastest) {
    const Shape *s = call->shape;
    const size_t pose = 3 * (size_t)s->joints, count = call->count;
    if ((size_t)given->len == count * s->observe * pose * sizeof(double) &&
        (size_t)made->len == count * s->horizon * pose * sizeof(float) &&
        (size_t)share->len == count * sizeof(float) && fastest->len == share->len)
        return 0;
    PyErr_SetString(PyExc_ValueError, "arrays of another size than the lists and the shape say");
    return -1;
}

/* Work with everything borrowed and checked; memory is the only thing that can fail. */
static int compute(Call *call) {
    const size_t size = 3 * (size_t)call->shape->horizon * call->shape->joints, count = call->count;
    const Encoded **encoded = malloc(count * sizeof *encoded);
    float **out = malloc(count * sizeof *out);
    char *done = malloc(count);
    call->encoded = malloc(count * sizeof *call->encoded);
    call->own = malloc(count * size * sizeof *call->own);
    call->apart = malloc(MAX_POINTS * sizeof *call->apart);
    call->amounts = malloc(count * MAX_RANK * sizeof *call->amounts);
    const int has_room =
        encoded && out && done && call->encoded && call->own && call->apart && call->amounts;
    if (has_room) {
        Py_BEGIN_ALLOW_THREADS run(call, encoded, out, done);
        Py_END_ALLOW_THREADS
    }
    free(encoded), free(out), free(done), free(call->encoded), free(call->own);
    free(call->apart), free(call->amounts);
    if (!has_room) PyErr_NoMemory();
    return has_room ? 0 : -1;
}

/* Everything that there is one of per window. */
static int compute_lists(Call *call, PyObject *const *lists) {
    int (*const checks[LISTS])(const Shape *, const Py_buffer *) = {check_decoder, check_gate, check_correction};
    const Py_ssize_t count = call->count;
    Py_buffer *views = PyMem_Malloc(LISTS * (count + 1) * sizeof *views);
    const void **pointers = PyMem_Malloc(LISTS * (count + 1) * sizeof *pointers);
    Py_ssize_t taken = 0, more = 0;
    int result = -1;
    if (!views || !pointers) {
        PyErr_NoMemory();
        goto free_all;
    }
    for (int list = 0; list < LISTS && more >= 0; list++) {
        more = borrow(lists[list], count, views + taken, pointers + list * count, call->shape, checks[list]);
        taken += more > 0 ? more : 0;
    }
    call->decoders = (const char **)pointers, call->gates = (const float **)(pointers + count);
    call->corrections = (const float **)(pointers + 2 * count);
    if (more >= 0 && check_pairs(call) == 0) result = compute(call);
    for (Py_ssize_t i = 0; i < taken; i++) PyBuffer_Release(&views[i]);
free_all:
    PyMem_Free(views), PyMem_Free(pointers);
    return result;
}

PyDoc_STRVAR(forecast_doc,
    "forecast(processor, shape, encoder, base, decoders, gates, corrections, windows, displacement, share, fastest)\n"
    "--\n\n"
    "Forecast windows, each by its own decoder as far as its gate finds it familiar, else by the base.\n\n"
    "processor: index into `processors`. shape: as `pack.py` gives it, like encoder, base, the list of\n"
    "decoders, the list of gates and that of corrections (None for none). windows: float64\n"
    "[n, observe, joints, 3], metres.\n"
    "displacement: float32 [n, horizon, joints, 3], is filled with metres from the last pose.\n"
    "share: float32 [n], is filled with the part that the own decoder has.\n"
    "fastest: float32 [n], is filled with the largest squared step of any joint, metres.");

static PyObject *forecast(PyObject *module, PyObject *args) {
    (void)module;
    Py_buffer shape, encoder, base, windows, displacement, share, fastest;
    PyObject *lists[LISTS], *result = NULL;
    Call call = {0};
    int processor;
    if (!PyArg_ParseTuple(args, "iy*y*y*O!O!O!y*w*w*w*", &processor, &shape, &encoder, &base, &PyList_Type, lists,
                          &PyList_Type, lists + 1, &PyList_Type, lists + 2, &windows, &displacement, &share, &fastest))
        return NULL;
    call.shape = shape.buf, call.encoder = encoder.buf, call.base = base.buf, call.windows = windows.buf;
    call.displacement = displacement.buf, call.share = share.buf, call.fastest = fastest.buf;
    call.count = (int)PyList_GET_SIZE(lists[0]);
    if (processor < 0 || processor >= KNOWN || !is_here(processor))
        PyErr_SetString(PyExc_ValueError, "this processor has no such instructions");
    else if (PyList_GET_SIZE(lists[1]) != call.count || PyList_GET_SIZE(lists[2]) != call.count)
        PyErr_SetString(PyExc_ValueError, "as many gates and corrections as decoders are needed");
    else if (check_shape(&shape) == 0 && check_encoder(call.shape, &encoder) == 0 &&
             check_decoder(call.shape, &base) == 0 &&
             check_arrays(&call, &windows, &displacement, &share, &fastest) == 0) {
        call.processor = &PROCESSORS[processor];
        if (compute_lists(&call, lists) == 0) result = Py_NewRef(Py_None);
    }
    PyBuffer_Release(&shape), PyBuffer_Release(&encoder), PyBuffer_Release(&base);
    PyBuffer_Release(&windows), PyBuffer_Release(&displacement), PyBuffer_Release(&share);
    PyBuffer_Release(&fastest);
    return result;
}

PyDoc_STRVAR(check_doc, "check(shape)\n--\n\nRaise ValueError where there is no kernel for nets of this shape.");

static PyObject *check(PyObject *module, PyObject *args) {
    (void)module;
    Py_buffer shape;
    if (!PyArg_ParseTuple(args, "y*", &shape)) return NULL;
    const int is_wrong = check_shape(&shape);
    PyBuffer_Release(&shape);
    return is_wrong ? NULL : Py_NewRef(Py_None);
}

PyDoc_STRVAR(probe_doc,
    "probe(processor, kind, block, times)\n--\n\n"
    "Do nothing useful as fast as this processor can: kind 0 reads a block as float32, 1 as float16, 2 as\n"
    "bfloat16, 3 multiplies and adds. Gives how many numbers were read, or how many operations done.");

static PyObject *probe(PyObject *module, PyObject *args) {
    (void)module;
    Py_buffer block;
    int processor, kind, times;
    if (!PyArg_ParseTuple(args, "iiy*i", &processor, &kind, &block, &times)) return NULL;
    double done = 0;
    if (processor < 0 || processor >= KNOWN || !is_here(processor) || kind < 0 || kind > KINDS)
        PyErr_SetString(PyExc_ValueError, "there is no such probe on this processor");
    else {
        const Processor *p = &PROCESSORS[processor];
        volatile float sink;
        Py_BEGIN_ALLOW_THREADS
        if (kind == FLOAT32) sink = p->read(block.buf, block.len / sizeof(float), times);
        if (kind == FLOAT16) sink = p->read_half(block.buf, block.len / sizeof(uint16_t), times);
        if (kind == BFLOAT16) sink = p->read_brief(block.buf, block.len / sizeof(uint16_t), times);
        if (kind == KINDS) sink = p->calculate(times);
        (void)sink;
        Py_END_ALLOW_THREADS
        done = kind == KINDS ? 32.0 * *p->lanes * times
                         : (double)times * block.len / (kind ? sizeof(uint16_t) : sizeof(float));
    }
    PyBuffer_Release(&block);
    return PyErr_Occurred() ? NULL : PyFloat_FromDouble(done);
}

static PyMethodDef METHODS[] = {{"forecast", forecast, METH_VARARGS, forecast_doc},
                                {"check", check, METH_VARARGS, check_doc},
                                {"probe", probe, METH_VARARGS, probe_doc},
                                {"survey", survey, METH_VARARGS, survey_doc},
                                {"find_fastest", find_fastest, METH_VARARGS, fastest_doc},
                                {"measure_body", measure_body, METH_VARARGS, measure_doc},
                                {"is_within", is_within, METH_VARARGS, within_doc},
                                {NULL, NULL, 0, NULL}};
static struct PyModuleDef MODULE = {
    PyModuleDef_HEAD_INIT, "_kernel", "Forecasts in the processor's cache; see pack.py and fused.py.", -1, METHODS,
    NULL, NULL, NULL, NULL};

PyMODINIT_FUNC PyInit__kernel(void) {
    PyObject *module = PyModule_Create(&MODULE), *names = PyList_New(0);
    for (int i = 0; module && names && i < KNOWN; i++) {
        if (!is_here(i)) continue;
        PyObject *pair = Py_BuildValue("(si)", PROCESSORS[i].name, i);
        if (!pair || PyList_Append(names, pair) < 0) PyErr_Print();
        Py_XDECREF(pair);
    }
    if (module && PyModule_AddObject(module, "processors", names) < 0) Py_DECREF(names);
    return module;
}
