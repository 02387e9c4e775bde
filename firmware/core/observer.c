#include "observer.h"

#include "number.h"

#define SLOWEST_PER_S 80.0f /* the observer's three poles are at 1 / derivative_filter_s, which the reading's noise
                               allows, but */
#define FASTEST_PER_S 150.0f /* within these; half: a bridge drives on longer, double: noise is taken for a load */
#define USUAL_PER_S 10.0f /* so fast the usual load follows; half: a load that gravity changes is none of it, double: a
                             bridge is */
#define SUDDEN_PER_S 2.0f /* and so fast after a sudden change; half: a payload is long a push, double: a bridge is
                             usual */
#define SUDDEN 0.25f      /* of the duty; half: usual loads are sudden, double: a bridge becomes usual at once */
#define PULL 0.15f /* of the duty accelerates it at least where its inertia is learnt; half: noise teaches, double: less
                      is learnt */
#define LEARNS_PER_S 20.0f /* so fast, of the squares of that; half: payloads are bridges for longer, double: bridges
                              are learnt */
#define LIGHTEST 0.6f /* of the configured inertia; half: bridges are learnt, double: nothing is */
#define HEAVIEST 3.0f /* likewise: payloads; half: those look like bridges, double: bridges are learnt */
#define AGREED_RAD 0.2f /* of such a way under usual loads; half: an inverted reading looks like a bridge, double: a
                           bridge shows later */
#define DRIVEN 0.9f /* of the supply, more than before: no push is so strong; half: pushes are bridges, double: no
                       bridge is */
#define DRIVEN_FAST 0.4f /* of that at the speed limit: there back-EMF brakes what is pushed; half: pushes are bridges,
                            double: bridges go beyond it */
#define DRIVEN_OFF 0.3f /* likewise, where nothing is put out; half: a joint whose inertia is another is one, double:
                           slow bridges drive on */
#define DRIVEN_RAD 0.008f /* so far; half: noise moves it, double: a bridge drives on longer */

void observer_move(observer_state *observer, float angle_rad)
{
    observer->position_rad = angle_rad;
    observer->load_duty = observer->usual_duty;
    observer->pull_duty = 0.0f;
    observer->driven_rad = angle_rad;
    observer->inertia = observer->inertia > 0.0f ? observer->inertia : 1.0f;
}

void observer_measure(observer_state *observer, const joint_gains *gains, float duty, float angle_rad)
{
    const float inertia = observer->inertia * gains->ka_s2_per_rad;
    if (inertia <= 0.0f) {
        return;
    }
    const float per_s = number_clamp(1.0f / (gains->derivative_filter_s + TICK_S), SLOWEST_PER_S, FASTEST_PER_S);
    const float own = gains->kv_s_per_rad - gains->kd_s_per_rad;
    const float left_duty = duty - own * observer->speed_rad_s - observer->load_duty;
    const float off_rad = angle_rad - observer->position_rad - TICK_S * observer->speed_rad_s;
    const float push = per_s * per_s * off_rad;
    const float sudden = observer->load_duty - observer->usual_duty;
    observer->pull_duty += TICK_S * per_s * (left_duty + sudden - observer->pull_duty);
    observer->position_rad += TICK_S * (observer->speed_rad_s + 3.0f * per_s * off_rad);
    observer->speed_rad_s += TICK_S * (left_duty / inertia + 3.0f * push);
    observer->load_duty -= TICK_S * inertia * per_s * push;
    const bool usual = number_size(sudden) < SUDDEN;
    observer->usual_duty += TICK_S * (usual ? USUAL_PER_S : SUDDEN_PER_S) * sudden;
    observer->agreed_rad += usual ? TICK_S * number_size(observer->speed_rad_s) : 0.0f;
    if (number_size(sudden) < 2.0f * SUDDEN && number_size(observer->pull_duty) > PULL) {
        /* a load that goes with the acceleration is inertia */
        const float more = TICK_S * LEARNS_PER_S * sudden * observer->pull_duty;
        observer->inertia = number_clamp(observer->inertia + more, LIGHTEST, HEAVIEST);
    }
}

bool observer_is_driven(observer_state *observer, float supply_duty, float fast, bool off)
{
    const float speed_rad_s = observer->speed_rad_s;
    const float sudden = speed_rad_s > 0.0f ? observer->usual_duty - observer->load_duty
                                            : observer->load_duty - observer->usual_duty;
    const float least = off ? DRIVEN_OFF : DRIVEN * (1.0f - DRIVEN_FAST * (fast < 1.0f ? fast : 1.0f));
    if (observer->agreed_rad <= AGREED_RAD || sudden <= least * supply_duty) {
        observer->driven_rad = observer->position_rad;
        return false;
    }
    const float way_rad = observer->position_rad - observer->driven_rad;
    return number_size(way_rad) > DRIVEN_RAD && way_rad * speed_rad_s > 0.0f;
}
