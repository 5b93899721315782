/* Sizes of the net, and the most that the kernels have room for. */
#ifndef KINECAST_SHAPE_H
#define KINECAST_SHAPE_H

#define TILE 64 /* outputs of a layer whose weights lie together */
#define ROWS 4  /* windows that share a pass over shared weights */
#define BLOCK 8 /* windows that the encoder takes at once */
#define TOKENS 3
#define MAX_OBSERVE 32
#define MAX_JOINTS 32
#define MAX_HIDDEN 256
#define MAX_TOKEN 128
#define MAX_Z 256
#define MAX_C 64
#define MAX_SPL 64
#define MAX_HEADS 16
#define MAX_RANK 64 /* directions of a correction */
#define MAX_POINTS 65536 /* of a gate */
#define MAX_INPUTS (3 * MAX_JOINTS + TOKENS * MAX_TOKEN + TILE)

/* As Python's `struct` gives it: int32, then float32. `order` lists joints, parents first; `parent`
   and `depth` are those of the joint at that place of `order`, `parent` again as a place. */
typedef struct {
    int observe, horizon, joints, hidden, heads, z, c, token, state, decoder_heads, spl;
    int hip, left_hip, right_hip, left_shoulder, right_shoulder, heading_frames, turns;
    int order[MAX_JOINTS], parent[MAX_JOINTS], depth[MAX_JOINTS];
    float min_across, scales[3], mean_pose[3 * MAX_JOINTS];
} Shape;

/* What the decoder gets of a window. */
typedef struct {
    float z[MAX_Z + MAX_C]; /* z, then c */
    float seed[3 * MAX_JOINTS];
    float cosine, sine;
} Encoded;

static inline int padded(int count, int to) { return (count + to - 1) / to * to; }

#endif
