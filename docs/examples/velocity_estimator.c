/* A velocity estimator in C for Marsyard's exchange, version 3 (docs/custom-algorithms.md).
 *
 *   cc -O2 -std=c11 -o velocity_estimator docs/examples/velocity_estimator.c -lm
 *   marsyard run dimes-gusev --algorithm "exec:./velocity_estimator"            one process a case
 *   marsyard run dimes-gusev --algorithm "serve:./velocity_estimator --serve"   one process for many
 *
 * Templates of the second image are searched for in the third around where the inertial velocity puts them, by
 * normalised correlation at whole pixels; each match gives a velocity over a level plane, and the median is reported.
 * It shows how to read a case and how to answer: it leaves out the radiometry, the lens' distortion and sub-pixel
 * places. The JSON is read by looking for its keys, which works because Marsyard writes each key of a table once.
 */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { HALF_COLUMNS = 20, HALF_ROWS = 5, REACH_COLUMNS = 48, REACH_ROWS = 14, ACROSS = 5, MOST = ACROSS * ACROSS };
static const double LEAST_CORRELATION = 0.6;
static const char *REFUSED = "\"outcome\": \"NO_VALID_TRACK\"";

typedef struct { int columns, rows; unsigned short *counts; } Image;
typedef struct { double c[3], a[3], h[3], v[3]; } Camera; /* the linear part of CAHVOR */

static void complain(const char *what, const char *where) { fprintf(stderr, "velocity_estimator: %s: %s\n", what, where); }

static char *contents(const char *path, long *size)
{
    FILE *file = fopen(path, "rb");
    if (!file) { complain("cannot open", path); return NULL; }
    fseek(file, 0, SEEK_END);
    *size = ftell(file);
    rewind(file);
    char *text = malloc((size_t)*size + 1);
    if (!text || fread(text, 1, (size_t)*size, file) != (size_t)*size) { complain("cannot read", path); free(text); text = NULL; }
    else text[*size] = '\0';
    fclose(file);
    return text;
}

static int read_image(const char *folder, int number, Image *image)
{
    char path[4096];
    long size;
    snprintf(path, sizeof path, "%s/image_%d.pgm", folder, number);
    unsigned char *raw = (unsigned char *)contents(path, &size);
    int most, head = 0;
    if (!raw) return 0;
    if (sscanf((char *)raw, "P5 %d %d %d%n", &image->columns, &image->rows, &most, &head) != 3 || most != 65535) {
        complain("no PGM of 16 bits", path);
        free(raw);
        return 0;
    }
    long count = (long)image->columns * image->rows;
    head += 1; /* one white space ends the header */
    if (size - head < 2 * count || !(image->counts = malloc(2 * (size_t)count))) {
        complain("too short", path);
        free(raw);
        return 0;
    }
    for (long k = 0; k < count; k++) /* the more significant byte comes first */
        image->counts[k] = (unsigned short)(raw[head + 2 * k] << 8 | raw[head + 2 * k + 1]);
    free(raw);
    return 1;
}

static int read_vector(const char *text, const char *name, double vector[3])
{
    char key[8];
    snprintf(key, sizeof key, "\n%s =", name);
    const char *at = strstr(text, key);
    return at && sscanf(at + strlen(key), "%lf %lf %lf", &vector[0], &vector[1], &vector[2]) == 3;
}

static int read_camera(const char *folder, int number, Camera *camera)
{
    char path[4096];
    long size;
    snprintf(path, sizeof path, "%s/camera_%d.cahvor", folder, number);
    char *text = contents(path, &size);
    if (!text) return 0;
    int fine = read_vector(text, "C", camera->c) && read_vector(text, "A", camera->a) &&
               read_vector(text, "H", camera->h) && read_vector(text, "V", camera->v);
    if (!fine) complain("no camera model", path);
    free(text);
    return fine;
}

/* The numbers behind the so manieth (from 1) of a key, brackets passed over. */
static int read_numbers(const char *text, const char *key, int occurrence, int count, double *numbers)
{
    char quoted[64];
    snprintf(quoted, sizeof quoted, "\"%s\":", key);
    for (int k = 0; k < occurrence; k++) {
        if (!(text = strstr(text, quoted))) { complain("the case has no", key); return 0; }
        text += strlen(quoted);
    }
    for (int k = 0; k < count; k++) {
        char *end;
        text += strspn(text, " \t\r\n[],");
        numbers[k] = strtod(text, &end);
        if (end == text) { complain("no number under", key); return 0; }
        text = end;
    }
    return 1;
}

static double dot(const double a[3], const double b[3]) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
static void cross(const double a[3], const double b[3], double out[3])
{
    out[0] = a[1] * b[2] - a[2] * b[1];
    out[1] = a[2] * b[0] - a[0] * b[2];
    out[2] = a[0] * b[1] - a[1] * b[0];
}

/* A vector turned by a unit quaternion (x, y, z, w): body axes to world axes; backwards where `back`. */
static void turned(const double q[4], const double v[3], int back, double out[3])
{
    double axis[3] = {q[0], q[1], q[2]}, w = back ? -q[3] : q[3], t[3], u[3];
    cross(axis, v, t);
    cross(axis, t, u);
    for (int k = 0; k < 3; k++) out[k] = v[k] + 2.0 * (w * t[k] + u[k]);
}

/* Where on the level ground a pixel looks: east and north of the camera, metres. */
static int ground(const Camera *camera, const double q[4], double altitude, double column, double row, double out[2])
{
    double p[3], r[3], ray[3], world[3];
    for (int k = 0; k < 3; k++) {
        p[k] = camera->h[k] - column * camera->a[k];
        r[k] = camera->v[k] - row * camera->a[k];
    }
    cross(p, r, ray);
    if (dot(ray, camera->a) < 0.0) for (int k = 0; k < 3; k++) ray[k] = -ray[k];
    turned(q, ray, 0, world);
    if (world[2] > -1e-9) return 0;
    out[0] = -altitude * world[0] / world[2];
    out[1] = -altitude * world[1] / world[2];
    return 1;
}

/* The pixel of a point of the ground, east and north of the camera. */
static int pixel(const Camera *camera, const double q[4], double altitude, const double at[2], double out[2])
{
    double world[3] = {at[0], at[1], -altitude}, body[3];
    turned(q, world, 1, body);
    double ahead = dot(body, camera->a);
    if (ahead <= 0.0) return 0;
    out[0] = dot(body, camera->h) / ahead;
    out[1] = dot(body, camera->v) / ahead;
    return 1;
}

/* Normalised correlation of two windows; -1 where one of them is featureless. */
static double correlation(const Image *a, int ac, int ar, const Image *b, int bc, int br)
{
    double n = 0, sa = 0, sb = 0, saa = 0, sbb = 0, sab = 0;
    for (int y = -HALF_ROWS; y <= HALF_ROWS; y++)
        for (int x = -HALF_COLUMNS; x <= HALF_COLUMNS; x++) {
            double va = a->counts[(long)(ar + y) * a->columns + ac + x], vb = b->counts[(long)(br + y) * b->columns + bc + x];
            n += 1; sa += va; sb += vb; saa += va * va; sbb += vb * vb; sab += va * vb;
        }
    double da = saa - sa * sa / n, db = sbb - sb * sb / n;
    return da < n || db < n ? -1.0 : (sab - sa * sb / n) / sqrt(da * db); /* less than a count of contrast is none */
}

static int inside(const Image *image, int column, int row)
{
    return column >= HALF_COLUMNS && row >= HALF_ROWS && column < image->columns - HALF_COLUMNS && row < image->rows - HALF_ROWS;
}

static int ascending(const void *a, const void *b) { double x = *(const double *)a, y = *(const double *)b; return (x > y) - (x < y); }

static double median(double *values, int count) { qsort(values, (size_t)count, sizeof *values, ascending); return values[count / 2]; }

static void estimate(const char *folder, char *answer, size_t room)
{
    char path[4096];
    long size;
    Image second = {0}, third = {0};
    Camera cameras[2];
    double q[2][4], altitudes[2], times[2], inertial[6], version[1];
    snprintf(path, sizeof path, "%s/case.json", folder);
    char *text = contents(path, &size);
    int fine = text && read_numbers(text, "exchange", 1, 1, version) && version[0] == 3.0;
    for (int k = 0; fine && k < 2; k++) /* of the three images the second and the third */
        fine = read_numbers(text, "world_from_body_xyzw", k + 2, 4, q[k]) && read_numbers(text, "altitude_m", k + 2, 1, &altitudes[k]) &&
               read_numbers(strstr(text, "\"images\":"), "time_s", k + 2, 1, &times[k]) && read_camera(folder, k + 2, &cameras[k]);
    fine = fine && read_numbers(text, "interval_velocities_m_s", 1, 6, inertial) && read_image(folder, 2, &second) && read_image(folder, 3, &third);
    snprintf(answer, room, "%s", REFUSED);
    if (fine) {
        double east[MOST], north[MOST], dt = times[1] - times[0];
        int found = 0;
        for (int k = 0; k < MOST; k++) {
            int column = second.columns * (k % ACROSS + 1) / (ACROSS + 1), row = second.rows * (k / ACROSS + 1) / (ACROSS + 1);
            double from[2], guess[2], centre[2], to[2], best = -1.0;
            int at_column = 0, at_row = 0;
            if (!inside(&second, column, row) || !ground(&cameras[0], q[0], altitudes[0], column, row, from)) continue;
            for (int axis = 0; axis < 2; axis++) guess[axis] = from[axis] - inertial[3 + axis] * dt;
            if (!pixel(&cameras[1], q[1], altitudes[1], guess, centre)) continue;
            for (int y = -REACH_ROWS; y <= REACH_ROWS; y++)
                for (int x = -REACH_COLUMNS; x <= REACH_COLUMNS; x++) {
                    int c = (int)lround(centre[0]) + x, r = (int)lround(centre[1]) + y;
                    double score = inside(&third, c, r) ? correlation(&second, column, row, &third, c, r) : -1.0;
                    if (score > best) { best = score; at_column = c; at_row = r; }
                }
            if (best < LEAST_CORRELATION || !ground(&cameras[1], q[1], altitudes[1], at_column, at_row, to)) continue;
            east[found] = (from[0] - to[0]) / dt; /* the ground stays: what it seems to move, the camera moves */
            north[found] = (from[1] - to[1]) / dt;
            found++;
        }
        fprintf(stderr, "%d of %d templates found\n", found, MOST);
        if (found >= 3)
            snprintf(answer, room, "\"outcome\": \"VALID\", \"velocity_m_s\": [%.17g, %.17g]", median(east, found), median(north, found));
    }
    free(second.counts);
    free(third.counts);
    free(text);
}

/* The number and the folder in a line {"exchange": 3, "id": 7, "case": "/tmp/..."}; Marsyard's folders need no escapes. */
static int read_request(char *line, long *id, char **folder)
{
    char *number = strstr(line, "\"id\": "), *at = strstr(line, "\"case\": \""), *end;
    if (!number || sscanf(number + 6, "%ld", id) != 1 || !at || !(end = strchr(at + 9, '"'))) return 0;
    *end = '\0';
    *folder = at + 9;
    return 1;
}

int main(int count, char **words)
{
    char answer[512], line[8192], *folder;
    long id;
    if (count == 2 && strcmp(words[1], "--serve") == 0) {
        printf("{\"exchange\": 3, \"ready\": true}\n");
        fflush(stdout);
        while (fgets(line, sizeof line, stdin)) {
            if (!read_request(line, &id, &folder)) { complain("no case in", line); return 1; }
            estimate(folder, answer, sizeof answer);
            printf("{\"exchange\": 3, \"id\": %ld, %s}\n", id, answer);
            fflush(stdout);
        }
        return 0;
    }
    if (count != 2) { fprintf(stderr, "usage: velocity_estimator CASE | velocity_estimator --serve\n"); return 2; }
    estimate(words[1], answer, sizeof answer);
    printf("{\"exchange\": 3, %s}\n", answer);
    return 0;
}
