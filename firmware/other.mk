# SPDX-License-Identifier: Apache-2.0
# The C tests on other machines: 32 bits of this one, and big-endian s390x under qemu-user. BearSSL comes from its source.
# And what cppcheck and clang-tidy say. `make -C firmware others`, `make -C firmware analyse`.

OTHERS := m32 s390x
CC_m32 := gcc -m32
CC_s390x := s390x-linux-gnu-gcc -static
RUN_s390x := qemu-s390x

.PHONY: others analyse misra
others: $(foreach cpu,$(OTHERS),$(foreach test,isotp vectors corpus,$(BUILD)/other/$(cpu)/$(test)))
	@for cpu in $(OTHERS); do \
	  run=$$(test $$cpu = s390x && echo $(RUN_s390x)); \
	  $$run $(BUILD)/other/$$cpu/isotp && $$run $(BUILD)/other/$$cpu/vectors && \
	  $$run $(BUILD)/other/$$cpu/corpus $(CORPUS) || exit 1; done

define OTHER_RULE
$(BUILD)/other/$(1)/bearssl.a: arm.mk other.mk
	@mkdir -p $(BUILD)/other/$(1)/bearssl
	cd $(BUILD)/other/$(1)/bearssl && $(CC_$(1)) -O2 $(BEARSSL_FLAGS) \
	  -I$(abspath $(BEARSSL))/inc -I$(abspath $(BEARSSL))/src -c $(abspath $(BEARSSL_SOURCES))
	@rm -f $$@
	$(AR) rcs $$@ $(BUILD)/other/$(1)/bearssl/*.o

$(BUILD)/other/$(1)/%: $(MEMORY) $(HEADERS) $(wildcard $(TESTS)/*) $(BUILD)/other/$(1)/bearssl.a
	$(CC_$(1)) $(filter-out -Wmissing-prototypes,$(WARNINGS)) -O1 $(IN_TESTS) $$(if $$(filter vectors,$$*),$(OF_VECTORS)) \
	  $$(if $$(filter corpus,$$*),-DTEDS_FUZZ_ALONE) $(INCLUDES) -isystem $(BEARSSL)/inc -I$(TESTS) -I$(VECTORS) $(MEMORY) \
	  $(TESTS)/$$(subst isotp,frames,$$(subst corpus,fuzz,$$*)).c $$(if $$(filter vectors,$$*),$$(wildcard $(VECTORS)/*.c)) \
	  $(BUILD)/other/$(1)/bearssl.a -o $$@
endef
$(foreach cpu,$(OTHERS),$(eval $(call OTHER_RULE,$(cpu))))

CHECKS := bugprone-*,cert-*,clang-analyzer-*,-bugprone-easily-swappable-parameters,-cert-err33-c,-bugprone-branch-clone,-clang-analyzer-security.insecureAPI.*
analyse: misra
	cppcheck --std=c99 --enable=warning,performance,portability --inline-suppr --error-exitcode=1 --quiet \
	  -DTEDS_NFC=1 -DTEDS_BLE=1 -DTEDS_MANAGED=1 -Iinclude -Isrc src port/bearssl
	clang-tidy-14 --quiet --warnings-as-errors='*' --checks='-*,$(CHECKS)' $(SOURCES) -- \
	  -std=c99 -DTEDS_NFC=1 -DTEDS_BLE=1 -DTEDS_MANAGED=1 -Iinclude -Isrc

# MISRA C:2012 by cppcheck's addon: which rules are broken is what docs/misra.md lists with reasons.
misra:
	@mkdir -p $(BUILD)
	cppcheck --std=c99 --addon=misra --quiet -DTEDS_NFC=1 -DTEDS_BLE=1 -DTEDS_MANAGED=1 -Iinclude -Isrc src port/bearssl 2>$(BUILD)/misra.txt
	@for rule in $$(grep -o 'misra-c2012-[0-9.]*[0-9]' $(BUILD)/misra.txt | sed 's/misra-c2012-//' | sort -u); do \
	  grep -q "^| $$rule |" docs/misra.md || \
	    { echo "MISRA C:2012 rule $$rule is not in docs/misra.md:"; grep -A1 "c2012-$$rule]" $(BUILD)/misra.txt; exit 1; }; done
