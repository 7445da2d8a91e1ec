/* SPDX-License-Identifier: Apache-2.0 */
#ifndef STANDIN_ADC_H
#define STANDIN_ADC_H

#include <zephyr/kernel.h>

struct adc_dt_spec {
    const struct device *dev;
    uint8_t channel_id;
};
struct adc_sequence {
    uint32_t channels;
    void *buffer;
    size_t buffer_size;
};
#define ADC_DT_SPEC_GET_BY_IDX(node, index) {&standin_adc, index}
bool adc_is_ready_dt(const struct adc_dt_spec *spec);
int adc_channel_setup_dt(const struct adc_dt_spec *spec);
int adc_sequence_init_dt(const struct adc_dt_spec *spec, struct adc_sequence *seq);
int adc_read_dt(const struct adc_dt_spec *spec, const struct adc_sequence *sequence);

#endif
