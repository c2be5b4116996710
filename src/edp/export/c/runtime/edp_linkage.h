/* The load of a grey box with a known linkage: planar rigid bodies in a row, each turned by one cylinder. */
#ifndef EDP_LINKAGE_H
#define EDP_LINKAGE_H

#include <stdint.h>

/* linkage: gravity, lengths of the bodies that carry another one, then for each body its actuator and at each knot
 * stroke, angle, and its first and second derivative by the stroke; numbers: mass, centre along and across and inertia of
 * each body; strokes and v (velocities): (BODIES), by actuator; mass (BODIES, BODIES) and force (BODIES):
 * written: inertia, and forces of gravity and of turning. Units are m, s, MN and Gg. */
void edp_linkage_load(const float *linkage, const float *numbers, const double *strokes, const double *v, double *mass,
                      double *force);

#endif
