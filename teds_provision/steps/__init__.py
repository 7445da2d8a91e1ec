"""Each step of provisioning: identify, whitelist, agree, build, sign, write, verify, provision, reset, address."""
