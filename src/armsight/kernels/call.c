/* Calls of compiled kernels from Python: what a call hands over is checked against the kernel's signature, and laid out as
 * a block of 64-bit words that the kernel's entry reads (build.py).
 *
 * The few functions of Python that are used belong to its stable binary interface, from 3.11 on; they are declared here, so
 * that no header of Python's is needed to build, for this machine or for another.
 *
 * A signature is a string. Scalars: b boolean, q Q i I h H c C integers of 8, 4, 2, 1 bytes, signed and unsigned, d f
 * floats. An array: [, 'r' where the kernel only reads it or 'w', the letter of its numbers, its number of dimensions,
 * 'C', 'F' or 'A' (contiguous by rows, by columns, any). A tuple: ( ... ). Results have the same letters; n is None.
 */

#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "call.h"

typedef struct _object PyObject;
typedef ptrdiff_t Py_ssize_t;

typedef struct {
    void *buf;
    PyObject *obj;
    Py_ssize_t len, itemsize;
    int readonly, ndim;
    char *format;
    Py_ssize_t *shape, *strides, *suboffsets;
    void *internal;
} Py_buffer;

typedef struct {
    const char *name;
    int type;
    Py_ssize_t offset;
    int flags;
    const char *doc;
} PyMemberDef;

typedef struct {
    const char *name;
    PyObject *(*get)(PyObject *, void *);
    int (*set)(PyObject *, PyObject *, void *);
    const char *doc;
    void *closure;
} PyGetSetDef;

typedef struct {
    int slot;
    void *pfunc;
} PyType_Slot;

typedef struct {
    const char *name;
    int basicsize, itemsize;
    unsigned int flags;
    PyType_Slot *slots;
} PyType_Spec;

typedef struct {
    Py_ssize_t refcount;
    void *type;
} Head;

typedef struct {
    const char *name;
    PyObject *(*function)(PyObject *, PyObject *);
    int flags;
    const char *doc;
} PyMethodDef;

typedef struct {
    union {
        Head head;
        int64_t split[2]; /* newer Pythons divide the first field; its size stays */
    } base;
    void *init;
    Py_ssize_t index;
    PyObject *copy;
} PyModuleDef_Base;

typedef struct {
    PyModuleDef_Base base;
    const char *name, *doc;
    Py_ssize_t size;
    PyMethodDef *methods;
    void *slots, *traverse, *clear, *free;
} PyModuleDef;

#if defined(_WIN32)
#define FROM_PYTHON extern __declspec(dllimport)
#define EXPORTED __declspec(dllexport)
#else
#define FROM_PYTHON extern
#define EXPORTED __attribute__((visibility("default")))
#endif

FROM_PYTHON PyObject *PyExc_TypeError, *PyExc_RuntimeError;
FROM_PYTHON PyObject _Py_NoneStruct;
FROM_PYTHON PyObject *PyObject_GenericGetDict(PyObject *, void *);
FROM_PYTHON int PyObject_GenericSetDict(PyObject *, PyObject *, void *);
FROM_PYTHON PyObject *PyErr_Format(PyObject *, const char *, ...);
FROM_PYTHON PyObject *PyErr_Occurred(void);
FROM_PYTHON void PyErr_Clear(void);
FROM_PYTHON int PyObject_GetBuffer(PyObject *, Py_buffer *, int);
FROM_PYTHON void PyBuffer_Release(Py_buffer *);
FROM_PYTHON Py_ssize_t PyTuple_Size(PyObject *);
FROM_PYTHON PyObject *PyTuple_GetItem(PyObject *, Py_ssize_t);
FROM_PYTHON PyObject *PyTuple_New(Py_ssize_t);
FROM_PYTHON int PyTuple_SetItem(PyObject *, Py_ssize_t, PyObject *);
FROM_PYTHON double PyFloat_AsDouble(PyObject *);
FROM_PYTHON PyObject *PyFloat_FromDouble(double);
FROM_PYTHON PyObject *PyNumber_Index(PyObject *);
FROM_PYTHON long long PyLong_AsLongLong(PyObject *);
FROM_PYTHON unsigned long long PyLong_AsUnsignedLongLong(PyObject *);
FROM_PYTHON PyObject *PyLong_FromLongLong(long long);
FROM_PYTHON PyObject *PyLong_FromUnsignedLongLong(unsigned long long);
FROM_PYTHON int PyObject_IsTrue(PyObject *);
FROM_PYTHON PyObject *PyBool_FromLong(long);
FROM_PYTHON PyObject *PyByteArray_FromStringAndSize(const char *, Py_ssize_t);
FROM_PYTHON PyObject *PyObject_CallFunction(PyObject *, const char *, ...);
FROM_PYTHON Py_ssize_t PyDict_Size(PyObject *);
FROM_PYTHON void Py_DecRef(PyObject *);
FROM_PYTHON void Py_IncRef(PyObject *);
FROM_PYTHON void *PyEval_SaveThread(void);
FROM_PYTHON void PyEval_RestoreThread(void *);
FROM_PYTHON PyObject *PyType_FromSpec(PyType_Spec *);
FROM_PYTHON PyObject *PyType_GenericAlloc(PyObject *, Py_ssize_t);
FROM_PYTHON void PyObject_Free(void *);
FROM_PYTHON PyObject *PyModule_Create2(PyModuleDef *, int);
FROM_PYTHON PyObject *PyUnicode_FromString(const char *);
FROM_PYTHON PyObject *PyList_New(Py_ssize_t);
FROM_PYTHON int PyList_Append(PyObject *, PyObject *);
FROM_PYTHON int PyArg_ParseTuple(PyObject *, const char *, ...);

enum { PYBUF_WRITABLE = 1, PYBUF_FORMAT = 4, PYBUF_STRIDES = 0x18, MOST_WORDS = 768, MOST_ARRAYS = 80, METH_VARARGS = 1 };
enum { SLOT_CALL = 50, SLOT_DEALLOC = 52, SLOT_REPR = 66, SLOT_MEMBERS = 72, SLOT_GETSET = 73, FLAGS_DEFAULT = 1 << 18 };
enum { T_PYSSIZET = 19, READONLY = 1 };

/* ---- what numba's code calls: memory of the arrays that kernels make, as a header and the numbers ---- */

typedef struct {
    size_t references;
    void (*destroy)(void *data, size_t size, void *info);
    void *info, *data;
    size_t size;
    void *external;
} Made;

#define HIDDEN __attribute__((visibility("hidden")))

HIDDEN void *NRT_Allocate(size_t size);
HIDDEN void NRT_Free(void *data);
HIDDEN Made *NRT_MemInfo_alloc(size_t size);
HIDDEN Made *NRT_MemInfo_alloc_aligned(size_t size, unsigned align);
HIDDEN Made *NRT_MemInfo_alloc_safe_aligned(size_t size, unsigned align);
HIDDEN Made *NRT_MemInfo_new_varsize_dtor(size_t size, void (*destroy)(void *, size_t, void *));
HIDDEN void *NRT_MemInfo_varsize_realloc(Made *made, size_t size);
HIDDEN void NRT_MemInfo_call_dtor(Made *made);
HIDDEN int numba_attempt_nocopy_reshape(ptrdiff_t count, const ptrdiff_t *shape, const ptrdiff_t *strides,
                                        ptrdiff_t new_count, const ptrdiff_t *new_shape, ptrdiff_t *new_strides,
                                        ptrdiff_t itemsize, int by_columns);

void *NRT_Allocate(size_t size) { return malloc(size); }

void NRT_Free(void *data) { free(data); }

Made *NRT_MemInfo_alloc_aligned(size_t size, unsigned align) {
    if (align < 64) {
        align = 64; /* a cache line */
    }
    Made *made = malloc(sizeof(Made) + align + size);
    if (made != NULL) {
        uintptr_t first = ((uintptr_t)(made + 1) + align - 1) / align * align;
        *made = (Made){1, NULL, NULL, (void *)first, size, NULL};
    }
    return made;
}

Made *NRT_MemInfo_alloc_safe_aligned(size_t size, unsigned align) { return NRT_MemInfo_alloc_aligned(size, align); }

Made *NRT_MemInfo_alloc(size_t size) { return NRT_MemInfo_alloc_aligned(size, 0); }

static void free_apart(void *data, size_t size, void *destroy) {
    if (destroy != NULL) {
        ((void (*)(void *, size_t, void *))destroy)(data, size, NULL);
    }
    free(data);
}

/* Of variable size: the numbers stand apart from the header. */
Made *NRT_MemInfo_new_varsize_dtor(size_t size, void (*destroy)(void *, size_t, void *)) {
    Made *made = malloc(sizeof(Made));
    void *data = malloc(size);
    if (made == NULL || data == NULL) {
        free(made);
        free(data);
        return NULL;
    }
    *made = (Made){1, free_apart, (void *)destroy, data, size, NULL};
    return made;
}

void *NRT_MemInfo_varsize_realloc(Made *made, size_t size) {
    void *data = realloc(made->data, size);
    if (data != NULL) {
        made->data = data;
        made->size = size;
    }
    return data;
}

void NRT_MemInfo_call_dtor(Made *made) {
    if (made->destroy != NULL) {
        made->destroy(made->data, made->size, made->info);
    }
    free(made);
}

static void let_go(Made *made) {
    if (made != NULL && __atomic_sub_fetch(&made->references, 1, __ATOMIC_ACQ_REL) == 0) {
        NRT_MemInfo_call_dtor(made);
    }
}

/* Give a contiguous array another shape; 0 where that is not possible without a copy. */
int numba_attempt_nocopy_reshape(ptrdiff_t count, const ptrdiff_t *shape, const ptrdiff_t *strides, ptrdiff_t new_count,
                                 const ptrdiff_t *new_shape, ptrdiff_t *new_strides, ptrdiff_t itemsize, int by_columns) {
    ptrdiff_t step = itemsize;
    for (ptrdiff_t n = count - 1; n >= 0; n--) {
        if (by_columns || (shape[n] != 1 && strides[n] != step)) {
            return 0;
        }
        step *= shape[n];
    }
    step = itemsize;
    for (ptrdiff_t n = new_count - 1; n >= 0; n--) {
        new_strides[n] = step;
        step *= new_shape[n];
    }
    return 1;
}

/* ---- one kernel ---- */

typedef struct {
    Head head;
    const Signature *first; /* the kernel's signatures stand side by side */
    int count;
    PyObject *dict;  /* what Python sets: __doc__, __wrapped__, ... */
    PyObject *array; /* makes an array from bytes, the letter of its numbers and its shape */
} Kernel;

typedef struct {
    uint64_t words[MOST_WORDS];
    int used;
    Py_buffer views[MOST_ARRAYS];
    int viewed;
    int position; /* of the argument that is read, from 1 */
} Block;

static size_t size_of(char letter) {
    switch (letter) {
        case 'q': case 'Q': case 'd': return 8;
        case 'i': case 'I': case 'f': return 4;
        case 'h': case 'H': return 2;
        default: return 1;
    }
}

/* Whether numbers of a buffer's format are those of a letter: of one kind and one size. */
static int same_numbers(const char *format, size_t size, char letter) {
    char is = format == NULL ? 'B' : format[0];
    if (is == '=' || is == '<' || is == '@') {
        is = *++format;
    }
    if (format != NULL && format[0] != '\0' && format[1] != '\0') {
        return 0;
    }
    if (size != size_of(letter)) {
        return 0;
    }
    switch (letter) {
        case 'b': return is == '?';
        case 'd': case 'f': return is == 'd' || is == 'f';
        case 'q': case 'i': case 'h': case 'c': return strchr("bhilqn", is) != NULL;
        default: return strchr("BHILQN", is) != NULL;
    }
}

static int contiguous(const Py_buffer *view, char order) {
    Py_ssize_t step = view->itemsize;
    if (order == 'A') {
        return 1;
    }
    for (int n = 0; n < view->ndim; n++) {
        if (view->shape[n] == 0) {
            return 1;
        }
    }
    for (int n = 0; n < view->ndim; n++) {
        int at = order == 'C' ? view->ndim - 1 - n : n;
        if (view->shape[at] != 1 && view->strides[at] != step) {
            return 0;
        }
        step *= view->shape[at];
    }
    return 1;
}

/* Read an array: the words that numba's code takes it as. Returns what comes after it in the signature, NULL where it is
 * none that fits. */
static const char *read_array(const char *code, PyObject *given, Block *block) {
    char access = code[1], letter = code[2], order = code[4];
    int dimensions = code[3] - '0';
    if (block->viewed == MOST_ARRAYS || block->used + 5 + 2 * dimensions > MOST_WORDS) {
        return NULL;
    }
    Py_buffer *view = &block->views[block->viewed];
    if (PyObject_GetBuffer(given, view, PYBUF_FORMAT | PYBUF_STRIDES | (access == 'w' ? PYBUF_WRITABLE : 0)) != 0) {
        PyErr_Clear();
        return NULL;
    }
    block->viewed++;
    if (view->ndim != dimensions || !same_numbers(view->format, (size_t)view->itemsize, letter) || !contiguous(view, order)) {
        return NULL;
    }
    uint64_t *words = block->words + block->used;
    words[0] = words[1] = 0;
    words[2] = 1;
    words[3] = (uint64_t)view->itemsize;
    words[4] = (uint64_t)(uintptr_t)view->buf;
    for (int n = 0; n < dimensions; n++) {
        words[2] *= (uint64_t)view->shape[n];
        words[5 + n] = (uint64_t)view->shape[n];
        words[5 + dimensions + n] = (uint64_t)view->strides[n];
    }
    block->used += 5 + 2 * dimensions;
    return code + 5;
}

/* Whether a whole number fits the bytes of its letter. */
static int fits(char letter, uint64_t word) {
    int64_t value = (int64_t)word;
    switch (letter) {
        case 'i': return value == (int32_t)value;
        case 'h': return value == (int16_t)value;
        case 'c': return value == (int8_t)value;
        case 'I': return word == (uint32_t)word;
        case 'H': return word == (uint16_t)word;
        case 'C': return word == (uint8_t)word;
        default: return 1;
    }
}

static const char *read_scalar(const char *code, PyObject *given, Block *block) {
    if (block->used == MOST_WORDS) {
        return NULL;
    }
    uint64_t *word = block->words + block->used++;
    *word = 0;
    if (code[0] == 'd' || code[0] == 'f') {
        double value = PyFloat_AsDouble(given);
        float single = (float)value;
        if (value == -1.0 && PyErr_Occurred() != NULL) {
            PyErr_Clear();
            return NULL;
        }
        memcpy(word, code[0] == 'd' ? (void *)&value : (void *)&single, size_of(code[0]));
        return code + 1;
    }
    if (code[0] == 'b') {
        int truth = PyObject_IsTrue(given);
        if (truth < 0) {
            PyErr_Clear();
            return NULL;
        }
        *word = (uint64_t)truth;
        return code + 1;
    }
    PyObject *whole = PyNumber_Index(given);
    if (whole == NULL) {
        PyErr_Clear();
        return NULL;
    }
    *word = strchr("QIHC", code[0]) != NULL ? (uint64_t)PyLong_AsUnsignedLongLong(whole) : (uint64_t)PyLong_AsLongLong(whole);
    Py_DecRef(whole);
    if (PyErr_Occurred() != NULL) {
        PyErr_Clear();
        return NULL;
    }
    return fits(code[0], *word) ? code + 1 : NULL;
}

/* Read the members of a tuple up to the end of the code or its closing bracket. */
static const char *read_members(const char *code, PyObject *tuple, Block *block, int outermost) {
    Py_ssize_t count = PyTuple_Size(tuple);
    if (count < 0) {
        PyErr_Clear();
        return NULL;
    }
    for (Py_ssize_t n = 0; n < count; n++) {
        if (outermost) {
            block->position = (int)n + 1;
        }
        if (*code == ')' || *code == '\0') {
            return NULL;
        }
        PyObject *member = PyTuple_GetItem(tuple, n);
        if (*code == '[') {
            code = read_array(code, member, block);
        } else if (*code == '(') {
            code = read_members(code + 1, member, block, 0);
            code = code == NULL ? NULL : code + 1;
        } else {
            code = read_scalar(code, member, block);
        }
        if (code == NULL) {
            return NULL;
        }
    }
    if (outermost) {
        block->position = (int)count + 1;
    }
    return *code == (outermost ? '\0' : ')') ? code : NULL;
}

static void release(Block *block) {
    for (int n = 0; n < block->viewed; n++) {
        PyBuffer_Release(&block->views[n]);
    }
    block->viewed = block->used = 0;
}

/* Return what Python sees of some words; both pointers move on. */
static PyObject *give(const char **code, const uint64_t **words, const Kernel *kernel) {
    char letter = *(*code)++;
    if (letter == 'n') {
        Py_IncRef(&_Py_NoneStruct);
        return &_Py_NoneStruct;
    }
    if (letter == '(') {
        int members = 0, depth = 0;
        for (const char *at = *code; depth > 0 || *at != ')'; at++) { /* how many there are */
            if (depth == 0) {
                members++;
            }
            if (*at == '(') {
                depth++;
            } else if (*at == ')') {
                depth--;
            } else if (*at == '[') {
                at += 4;
            }
        }
        PyObject *tuple = PyTuple_New(members);
        for (int n = 0; tuple != NULL && n < members; n++) {
            PyObject *member = give(code, words, kernel);
            if (member == NULL) {
                Py_DecRef(tuple);
                return NULL;
            }
            PyTuple_SetItem(tuple, n, member);
        }
        (*code)++;
        return tuple;
    }
    if (letter == '[') {
        const uint64_t *at = *words;
        char number = (*code)[1];
        int dimensions = (*code)[2] - '0';
        PyObject *shape = PyTuple_New(dimensions);
        for (int n = 0; shape != NULL && n < dimensions; n++) {
            PyTuple_SetItem(shape, n, PyLong_FromLongLong((long long)at[5 + n]));
        }
        PyObject *bytes = PyByteArray_FromStringAndSize((char *)(uintptr_t)at[4], (Py_ssize_t)(at[2] * at[3]));
        let_go((Made *)(uintptr_t)at[0]);
        char text[2] = {number, '\0'};
        PyObject *made = shape == NULL || bytes == NULL
                             ? NULL
                             : PyObject_CallFunction(kernel->array, "OsO", bytes, text, shape);
        if (shape != NULL) {
            Py_DecRef(shape);
        }
        if (bytes != NULL) {
            Py_DecRef(bytes);
        }
        *code += 4;
        *words += 5 + 2 * dimensions;
        return made;
    }
    const uint64_t *word = (*words)++;
    switch (letter) {
        case 'd': { double x; memcpy(&x, word, 8); return PyFloat_FromDouble(x); }
        case 'f': { float x; memcpy(&x, word, 4); return PyFloat_FromDouble((double)x); }
        case 'b': return PyBool_FromLong((long)(*word & 1));
        case 'q': return PyLong_FromLongLong((long long)*word);
        case 'i': return PyLong_FromLongLong((int32_t)*word);
        case 'h': return PyLong_FromLongLong((int16_t)*word);
        case 'c': return PyLong_FromLongLong((int8_t)*word);
        case 'Q': return PyLong_FromUnsignedLongLong(*word);
        case 'I': return PyLong_FromUnsignedLongLong((uint32_t)*word);
        case 'H': return PyLong_FromUnsignedLongLong((uint16_t)*word);
        default: return PyLong_FromUnsignedLongLong((uint8_t)*word);
    }
}

static PyObject *call(Kernel *self, PyObject *arguments, PyObject *named) {
    Block block;
    uint64_t result[MOST_WORDS / 4];
    int furthest = 0;
    block.used = block.viewed = 0;
    if (named != NULL && PyDict_Size(named) > 0) {
        return PyErr_Format(PyExc_TypeError, "%s.%s: a kernel takes no named arguments", self->first->module, self->first->name);
    }
    for (int n = 0; n < self->count; n++) {
        const Signature *signature = self->first + n;
        block.position = 0;
        if (read_members(signature->takes, arguments, &block, 1) == NULL) {
            furthest = block.position > furthest ? block.position : furthest;
            release(&block);
            continue;
        }
        int failed;
        if (signature->releases_lock) {
            void *state = PyEval_SaveThread();
            failed = signature->entry(block.words, result);
            PyEval_RestoreThread(state);
        } else {
            failed = signature->entry(block.words, result);
        }
        release(&block);
        if (failed) {
            return PyErr_Format(PyExc_RuntimeError, "%s.%s: the kernel failed: out of memory, or shapes that contradict",
                                signature->module, signature->name);
        }
        const char *code = signature->gives;
        const uint64_t *words = result;
        return give(&code, &words, self);
    }
    return PyErr_Format(PyExc_TypeError, "%s.%s: argument %d is not what its signature %s says (numbers, dimensions, order or"
                        " rights to write)", self->first->module, self->first->name, furthest, self->first->takes);
}

static void destroy(Kernel *self) {
    PyObject *type = self->head.type;
    Py_DecRef(self->array);
    if (self->dict != NULL) {
        Py_DecRef(self->dict);
    }
    PyObject_Free(self);
    Py_DecRef(type);
}

static PyObject *represent(Kernel *self) {
    (void)self;
    return PyUnicode_FromString(self->first->name);
}

static PyMemberDef members[] = {{"__dictoffset__", T_PYSSIZET, offsetof(Kernel, dict), READONLY, NULL}, {NULL, 0, 0, 0, NULL}};
static PyGetSetDef properties[] = {{"__dict__", PyObject_GenericGetDict, PyObject_GenericSetDict, NULL, NULL},
                                   {NULL, NULL, NULL, NULL, NULL}};
static PyType_Slot slots[] = {
    {SLOT_MEMBERS, (void *)members},
    {SLOT_GETSET, (void *)properties},
    {SLOT_CALL, (void *)call}, {SLOT_DEALLOC, (void *)destroy}, {SLOT_REPR, (void *)represent}, {0, NULL}};
static PyType_Spec spec = {"armsight.kernels.Kernel", sizeof(Kernel), 0, FLAGS_DEFAULT, slots};
static PyObject *kernel_type;

#if defined(__x86_64__)
static void identify(uint32_t leaf, uint32_t part, uint32_t out[4]) {
    __asm__ volatile("cpuid" : "=a"(out[0]), "=b"(out[1]), "=c"(out[2]), "=d"(out[3]) : "a"(leaf), "c"(part));
}

/* Whether the processor and its system have all of x86-64-v3: AVX2, FMA, F16C, MOVBE, BMI, BMI2, LZCNT. */
static int has_v3(void) {
    const uint32_t first = 1u << 12 | 1u << 22 | 1u << 27 | 1u << 28 | 1u << 29, seventh = 1u << 3 | 1u << 5 | 1u << 8;
    uint32_t r[4], low, high;
    identify(0, 0, r);
    if (r[0] < 7) {
        return 0;
    }
    identify(1, 0, r);
    if ((r[2] & first) != first) {
        return 0;
    }
    __asm__ volatile("xgetbv" : "=a"(low), "=d"(high) : "c"(0));
    identify(7, 0, r);
    if ((low & 6) != 6 || (r[1] & seventh) != seventh) {
        return 0;
    }
    identify(0x80000001u, 0, r);
    return (r[2] & 1u << 5) != 0;
}
#endif

/* Return the kernels for this processor; NULL, with an exception, where they were built on another machine for its newer one.
 * ARMSIGHT_KERNELS=baseline asks for those that run on every one of its kind. */
static const Level *level(void) {
    const Level *last = armsight_levels + armsight_level_count - 1;
    const char *asked = getenv("ARMSIGHT_KERNELS");
    int newest = asked == NULL || strcmp(asked, "baseline") != 0;
#if defined(__x86_64__)
    newest = newest && has_v3();
    if (!has_v3() && strcmp(last->processor, "x86-64-v3") == 0) {
        PyErr_Format(PyExc_RuntimeError, "armsight's kernels were built for processors with AVX2 only, which this one has not:"
                     " install a wheel, or build armsight here");
        return NULL;
    }
#endif
    return newest ? armsight_levels : last;
}

static PyObject *find(PyObject *self, PyObject *arguments) {
    const char *module, *name;
    PyObject *array;
    (void)self;
    if (!PyArg_ParseTuple(arguments, "ssO", &module, &name, &array)) {
        return NULL;
    }
    const Level *chosen = level();
    if (chosen == NULL) {
        return NULL;
    }
    for (int n = 0; n < armsight_signature_count; n++) {
        const Signature *first = chosen->signatures + n;
        if (strcmp(first->module, module) == 0 && strcmp(first->name, name) == 0) {
            Kernel *found = (Kernel *)PyType_GenericAlloc(kernel_type, 0);
            if (found == NULL) {
                return NULL;
            }
            found->first = first;
            found->count = 1;
            while (n + found->count < armsight_signature_count && strcmp(first[found->count].module, module) == 0 &&
                   strcmp(first[found->count].name, name) == 0) {
                found->count++;
            }
            found->array = array;
            Py_IncRef(array);
            return (PyObject *)found;
        }
    }
    Py_IncRef(&_Py_NoneStruct);
    return &_Py_NoneStruct;
}

static PyObject *sources(PyObject *self, PyObject *arguments) {
    PyObject *list = PyList_New(0);
    (void)self, (void)arguments;
    for (int n = 0; list != NULL && n < armsight_source_count; n++) {
        PyObject *pair = PyTuple_New(2);
        PyTuple_SetItem(pair, 0, PyUnicode_FromString(armsight_sources[n].module));
        PyTuple_SetItem(pair, 1, PyUnicode_FromString(armsight_sources[n].digest));
        PyList_Append(list, pair);
        Py_DecRef(pair);
    }
    return list;
}

static PyMethodDef methods[] = {{"sources", sources, METH_VARARGS, "Return the modules that were compiled, with digests of their text and code."},
                                {"find", find, METH_VARARGS, "Return a kernel by module and name; None where there is none."},
                                {NULL, NULL, 0, NULL}};
static PyModuleDef definition = {.base = {.base = {.head = {1, NULL}}}, .name = "_compiled", .size = -1, .methods = methods};

EXPORTED PyObject *PyInit__compiled(void);

PyObject *PyInit__compiled(void) {
    kernel_type = PyType_FromSpec(&spec);
    return kernel_type == NULL ? NULL : PyModule_Create2(&definition, 3);
}
