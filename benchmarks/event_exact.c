/* Jointed drives with Coulomb friction, simulated event by event.
 *
 * It knows nothing of MuJoCo: links move by Newton and Euler, one after the other; a joint sticks or slides, and the
 * moment at which it changes is found within a step. Friction of a joint that slides at v, under a motor torque u:
 *
 *     sign(v) (c + (s - c) exp(-(v / w)^2) + l |u - e| + r sin(p q)) + d v,    c of its direction, e the torque from
 *                                                                             outside, q its position
 *
 * and what holds a joint that sticks goes up to s + l |u - e| + r sin(p q). With a bristle stiffness k it is LuGre's instead, whose
 * deflection z moves by z' = v - k |v| z / g(v), and whose torque is k z + d v.
 *
 * Sources: R. Featherstone, "Rigid Body Dynamics Algorithms", 2008, section 5.3; B. Armstrong-Helouvry, P. Dupont,
 * C. Canudas de Wit, Automatica 30(7), 1994; C. Canudas de Wit et al., IEEE Trans. Autom. Control 40(3), 1995.
 */
#include <math.h>
#include <string.h>

#define MOST 16

typedef struct {
    double axis[3], place[3], mass, centre[3], inertia[9]; /* in its own frame, inertia about the centre of mass */
} Link;

typedef struct {
    double armature, viscous, forward, backward, breakaway, stribeck, load, bristle;
    double kp, kd, delay, limit, offset, gain, ripple, periods;
} Drive;

typedef struct {
    int count;
    const int *parent;
    const Link *links;
    const Drive *drives;
    const double *gravity;
    double turned[MOST][9];
} Tree;

static void cross(const double *a, const double *b, double *out) {
    out[0] = a[1] * b[2] - a[2] * b[1];
    out[1] = a[2] * b[0] - a[0] * b[2];
    out[2] = a[0] * b[1] - a[1] * b[0];
}

static void times(const double *m, const double *v, double *out) {
    for (int i = 0; i < 3; i++) out[i] = m[3 * i] * v[0] + m[3 * i + 1] * v[1] + m[3 * i + 2] * v[2];
}

static void back(const double *m, const double *v, double *out) {
    for (int i = 0; i < 3; i++) out[i] = m[i] * v[0] + m[3 + i] * v[1] + m[6 + i] * v[2];
}

static double dot(const double *a, const double *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

static void turn(Tree *tree, const double *q) {
    for (int i = 0; i < tree->count; i++) {
        const double *n = tree->links[i].axis, c = cos(q[i]), s = sin(q[i]);
        const double skew[9] = {0, -n[2], n[1], n[2], 0, -n[0], -n[1], n[0], 0};
        for (int r = 0; r < 3; r++)
            for (int k = 0; k < 3; k++)
                tree->turned[i][3 * r + k] = (r == k) * c + (1 - c) * n[r] * n[k] + s * skew[3 * r + k];
    }
}

/* Torques at the joints for these velocities and accelerations, without armatures. */
static void torques(const Tree *tree, const double *qd, const double *qdd, int falls, double *tau) {
    double w[MOST][3], al[MOST][3], a[MOST][3], f[MOST][3], n[MOST][3];
    const double zero[3] = {0, 0, 0}, lift[3] = {-tree->gravity[0], -tree->gravity[1], -tree->gravity[2]};
    for (int i = 0; i < tree->count; i++) {
        const Link *link = &tree->links[i];
        const int p = tree->parent[i];
        const double *wp = p < 0 ? zero : w[p], *alp = p < 0 ? zero : al[p];
        const double *ap = p < 0 ? (falls ? lift : zero) : a[p];
        double t1[3], t2[3], t3[3], spin[3], c1[3], c2[3], c3[3], at[3], iw[3], ia[3];
        cross(alp, link->place, t1);
        cross(wp, link->place, t2);
        cross(wp, t2, t3);
        for (int k = 0; k < 3; k++) t1[k] += ap[k] + t3[k];
        back(tree->turned[i], t1, a[i]);
        back(tree->turned[i], wp, w[i]);
        back(tree->turned[i], alp, al[i]);
        for (int k = 0; k < 3; k++) spin[k] = link->axis[k] * qd[i];
        cross(w[i], spin, t1);
        for (int k = 0; k < 3; k++) w[i][k] += spin[k], al[i][k] += t1[k] + link->axis[k] * qdd[i];
        cross(al[i], link->centre, c1);
        cross(w[i], link->centre, c2);
        cross(w[i], c2, c3);
        for (int k = 0; k < 3; k++) at[k] = a[i][k] + c1[k] + c3[k], f[i][k] = link->mass * at[k];
        times(link->inertia, al[i], ia);
        times(link->inertia, w[i], iw);
        cross(w[i], iw, t1);
        cross(link->centre, f[i], t2);
        for (int k = 0; k < 3; k++) n[i][k] = ia[k] + t1[k] + t2[k];
    }
    for (int i = tree->count - 1; i >= 0; i--) {
        const int p = tree->parent[i];
        tau[i] = dot(tree->links[i].axis, n[i]);
        if (p < 0) continue;
        double force[3], moment[3], lever[3];
        times(tree->turned[i], f[i], force);
        times(tree->turned[i], n[i], moment);
        cross(tree->links[i].place, force, lever);
        for (int k = 0; k < 3; k++) f[p][k] += force[k], n[p][k] += moment[k] + lever[k];
    }
}

static double level(const Drive *drive, double q, double v, double sign, double load) {
    const double c = sign < 0 ? drive->backward : drive->forward, share = v / drive->stribeck;
    const double dry = c * (1 + (drive->breakaway - 1) * exp(-share * share)) + drive->load * fabs(load);
    return drive->ripple ? dry + drive->ripple * sin(drive->periods * q) : dry;
}

/* Solve for the accelerations of the joints that slide; the others have none. */
static void solve(int count, double m[MOST][MOST], const double *right, const int *sign, double *out) {
    int own[MOST], size = 0;
    double a[MOST][MOST], b[MOST];
    for (int i = 0; i < count; i++) {
        out[i] = 0;
        if (sign[i]) own[size++] = i;
    }
    for (int i = 0; i < size; i++) {
        b[i] = right[own[i]];
        for (int k = 0; k < size; k++) a[i][k] = m[own[i]][own[k]];
    }
    for (int i = 0; i < size; i++)
        for (int k = i + 1; k < size; k++) {
            const double share = a[k][i] / a[i][i];
            for (int j = i; j < size; j++) a[k][j] -= share * a[i][j];
            b[k] -= share * b[i];
        }
    for (int i = size - 1; i >= 0; i--) {
        for (int k = i + 1; k < size; k++) b[i] -= a[i][k] * out[own[k]];
        out[own[i]] = b[i] / a[i][i];
    }
}

/* Accelerations and slopes of bristles; with `free`, joints that nothing holds any more begin to slide. */
static void slopes(Tree *tree, const double *q, const double *v, const double *z, const double *command, int *sign,
                   int free, double *a, double *dz) {
    const int count = tree->count;
    double m[MOST][MOST], bias[MOST], unit[MOST], column[MOST], push[MOST], right[MOST], load[MOST];
    turn(tree, q);
    memset(unit, 0, sizeof unit);
    torques(tree, v, unit, 1, bias);
    const double still[MOST] = {0};
    for (int i = 0; i < count; i++) {
        unit[i] = 1;
        torques(tree, still, unit, 0, column);
        unit[i] = 0;
        for (int k = 0; k < count; k++) m[k][i] = column[k];
        m[i][i] += tree->drives[i].armature;
    }
    for (int i = 0; i < count; i++) {
        const Drive *d = &tree->drives[i];
        double motor = d->gain * (d->kp * (command[i] - q[i]) - d->kd * v[i]);
        if (d->limit > 0) motor = fmax(-d->limit, fmin(d->limit, motor));
        load[i] = motor + bias[i];
        push[i] = motor + d->offset - bias[i] - d->viscous * v[i];
        dz[i] = 0;
        if (d->bristle > 0) {
            push[i] -= d->bristle * z[i];
            dz[i] = v[i] - d->bristle * fabs(v[i]) * z[i] / level(d, q[i], v[i], v[i], load[i]);
        }
    }
    for (int again = 0; again <= count; again++) {
        int worst = -1;
        double most = 0;
        for (int i = 0; i < count; i++) {
            right[i] = push[i];
            if (sign[i] && tree->drives[i].bristle <= 0) right[i] -= sign[i] * level(&tree->drives[i], q[i], v[i], sign[i], load[i]);
        }
        solve(count, m, right, sign, a);
        for (int i = 0; free && i < count; i++) {
            if (sign[i]) continue;
            double pull = push[i];
            for (int k = 0; k < count; k++) pull -= m[i][k] * a[k];
            const double over = fabs(pull) - level(&tree->drives[i], q[i], 0, pull, load[i]);
            if (over > most) most = over, worst = pull > 0 ? i : i + count;
        }
        if (worst < 0) return;
        sign[worst % count] = worst < count ? 1 : -1;
    }
}

/* Simulate so many samples; returns the share of time and joints that sticks.
 *
 * ctrl and out are (samples, count) and (samples, 2, count); commands are held over their interval, late by `delay`.
 */
double simulate(int count, const int *parent, const Link *links, const Drive *drives, const double *gravity,
                int samples, double interval, int steps, const double *ctrl, double *out) {
    Tree tree = {count, parent, links, drives, gravity, {{0}}};
    double q[MOST], v[MOST] = {0}, z[MOST] = {0}, a[MOST], dz[MOST], qm[MOST], vm[MOST], zm[MOST], next[MOST];
    double command[MOST], sticking = 0;
    const double step = interval / steps;
    int sign[MOST];
    for (int i = 0; i < count; i++) q[i] = ctrl[i], sign[i] = drives[i].bristle > 0;
    for (int sample = 0; sample < samples; sample++) {
        memcpy(out + 2 * sample * count, q, count * sizeof *q);
        memcpy(out + (2 * sample + 1) * count, v, count * sizeof *v);
        for (int number = 0; number < steps; number++) {
            const double time = (number + 0.5) * step;
            for (int i = 0; i < count; i++) {
                const int late = sample + (int)floor((time - drives[i].delay) / interval);
                command[i] = ctrl[(late > 0 ? late : 0) * count + i];
                sticking += sign[i] == 0;
            }
            double left = step;
            for (int part = 0; left > 1e-12 * step && part < 4 * count + 4; part++) {
                slopes(&tree, q, v, z, command, sign, 1, a, dz);
                for (int i = 0; i < count; i++) {
                    qm[i] = q[i] + left / 2 * v[i];
                    vm[i] = v[i] + left / 2 * a[i];
                    zm[i] = z[i] + left / 2 * dz[i];
                }
                slopes(&tree, qm, vm, zm, command, sign, 0, a, dz);
                double share = 1;
                int stops = -1;
                for (int i = 0; i < count; i++) {
                    next[i] = v[i] + left * a[i];
                    if (sign[i] && drives[i].bristle <= 0 && sign[i] * next[i] < 0) {
                        const double own = sign[i] * v[i] > 0 ? v[i] / (v[i] - next[i]) : 0;
                        if (own < share) share = own, stops = i;
                    }
                }
                const double taken = share * left;
                for (int i = 0; i < count; i++) {
                    q[i] += taken * (v[i] + taken / 2 * a[i]);
                    v[i] += taken * a[i];
                    z[i] += taken * dz[i];
                }
                if (stops >= 0) v[stops] = 0, sign[stops] = 0;
                left -= taken;
            }
        }
    }
    return sticking / ((double)samples * steps * count);
}
