/* SPDX-License-Identifier: Apache-2.0 */
#ifndef STANDIN_PWM_H
#define STANDIN_PWM_H

#include <zephyr/kernel.h>

struct pwm_dt_spec {
    const struct device *dev;
    uint32_t channel, period;
};
#define PWM_DT_SPEC_GET(node) {&standin_pwm, 1, 20000000u}
bool pwm_is_ready_dt(const struct pwm_dt_spec *spec);
int pwm_set_pulse_dt(const struct pwm_dt_spec *spec, uint32_t pulse);

#endif
