/* SPDX-License-Identifier: Apache-2.0 */
/* Prototypes of Nordic's library (sdk-nrfxlib, nfc/include/nfc_t4t_lib.h): to compile against, nothing is behind them. */
#ifndef STANDIN_NFC_T4T_LIB_H
#define STANDIN_NFC_T4T_LIB_H

#include <stddef.h>
#include <stdint.h>

typedef enum {
    NFC_T4T_EVENT_NONE,
    NFC_T4T_EVENT_FIELD_ON,
    NFC_T4T_EVENT_FIELD_OFF,
    NFC_T4T_EVENT_NDEF_READ,
    NFC_T4T_EVENT_NDEF_UPDATED,
    NFC_T4T_EVENT_DATA_TRANSMITTED,
    NFC_T4T_EVENT_DATA_IND
} nfc_t4t_event_t;
#define NFC_T4T_DI_FLAG_MORE 0x01
typedef void (*nfc_t4t_callback_t)(void *context, nfc_t4t_event_t event, const uint8_t *data, size_t data_length,
                                   uint32_t flags);
int nfc_t4t_setup(nfc_t4t_callback_t callback, void *context);
int nfc_t4t_emulation_start(void);
int nfc_t4t_response_pdu_send(const uint8_t *pdu, size_t pdu_length);

#endif
