#!/usr/bin/env bash
# Runs three slots of Act and one slot of a hosted environment with grpcurl, and fails on any unexpected response.
#
#   clients/grpc/smoke.sh HOST:PORT
#
# GRPCURL: the grpcurl program (default: grpcurl); works with the original in Go and with the crate grpcurl-rs.
# POLICY:  the policy to run (default: sweep).
set -euo pipefail

address=${1:?usage: smoke.sh HOST:PORT}
grpcurl=${GRPCURL:-grpcurl}
policy=${POLICY:-sweep}
service=qedgix.v1.PolicyService
session=smoke-$$-$(date +%s)

fail() {
    echo "smoke: $*" >&2
    exit 1
}

# Calls a method of $service. Removes whitespace, because the two programs format JSON differently.
call() {
    local method=$1 request=$2
    "$grpcurl" --plaintext -d "$request" "$address" "$service/$method" | tr -d ' \n\t'
}

expect() {
    local what=$1 answer=$2 pattern=$3
    [[ $answer =~ $pattern ]] || fail "$what: expected $pattern in: $answer"
}

# The request of one slot: three UAVs at the centre and five users, one of them detected.
slot() {
    local step=$1 uavs="" users="" i
    for i in 1 2 3; do
        uavs+="{\"id\":\"uav-$i\",\"x\":0.5,\"y\":0.5},"
    done
    for i in 1 2 3 4 5; do
        users+="{\"id\":\"user-$i\",\"x\":0.$((i * 2 - 1)),\"y\":0.6,\"aoi\":$step},"
    done
    printf '{"policy":"%s","session_id":"%s","step":%d,"scene":{"uavs":[%s],"users":[%s]}}' \
        "$policy" "$session" "$step" "${uavs%,}" "${users%,}"
}

services=$("$grpcurl" --plaintext "$address" list)
for name in "$service" qedgix.v1.EnvironmentService inference.GRPCInferenceService grpc.health.v1.Health; do
    grep -qxF "$name" <<<"$services" || fail "missing in the list of services: $name: $services"
done

description=$("$grpcurl" --plaintext "$address" describe "$service")
for method in Act OpenSession CloseSession ListPolicies GetPolicy; do
    grep -qE "rpc $method \(" <<<"$description" || fail "missing in $service: $method: $description"
done

health=$("$grpcurl" --plaintext -d "{\"service\":\"$service\"}" "$address" grpc.health.v1.Health/Check)
grep -qF '"SERVING"' <<<"$health" || fail "not serving: $health"

answer=$(call GetPolicy "{\"policy\":\"$policy\"}")
expect GetPolicy "$answer" '"digest":"[0-9a-f]{64}"'
answer=$(call OpenSession "{\"policy\":\"$policy\",\"session_id\":\"$session\",\"seed\":7}")
expect OpenSession "$answer" "\"sessionId\":\"$session\""

# JSON omits fields that are zero: heading 0 and step 0.
action='\{"uavId":"uav-N"(,"headingIndex":[1-8])?(,"headingDeg":(0|[0-9.]+))?\}'
last=
for step in 0 1 2; do
    last=$(call Act "$(slot "$step")")
    for i in 1 2 3; do
        expect "Act, step $step" "$last" "${action/N/$i}"
    done
    [ "$step" = 0 ] || expect "Act, step $step" "$last" "\"step\":\"$step\""
done

headings() { grep -o '"actions":\[[^]]*\]' <<<"$1"; }
repeated=$(call Act "$(slot 2)")
[ "$(headings "$repeated")" = "$(headings "$last")" ] || fail "repeating step 2 returned another response: $repeated, before: $last"

if refused=$(call Act "$(slot 7)" 2>&1); then
    fail "step 7 after step 2 was not refused: $refused"
fi
expect "Act, step 7" "$refused" '(FailedPrecondition|FAILED_PRECONDITION)'

answer=$(call CloseSession "{\"session_id\":\"$session\"}")
expect CloseSession "$answer" '"steps":"3"'
if refused=$(call CloseSession "{\"session_id\":\"$session\"}" 2>&1); then
    fail "closing a closed session was not refused: $refused"
fi
expect "CloseSession, repeated" "$refused" '(NotFound|NOT_FOUND)'

service=qedgix.v1.EnvironmentService
environment="\"environment_id\":\"$session\""
answer=$(call CreateEnvironment "{$environment,\"environment\":{\"M\":2,\"N\":4,\"K\":1},\"count\":2}")
expect CreateEnvironment "$answer" '"slots":1[,}]'
answer=$(call Reset "{$environment}")
expect Reset "$answer" '"uavs":\[\{"id":"uav-0","x":0.5,"y":0.5\}'
step_request="{$environment,\"step\":0,\"actions\":[{\"headings\":[0,3]},{\"headings\":[5,1]}]}"
answer=$(call Step "$step_request")
expect Step "$answer" '"meanAoi":[0-9.]+'
[ "$(call Step "$step_request")" = "$answer" ] || fail "repeating Step returned another response"
if refused=$(call Step "${step_request/:0,/:1,}" 2>&1); then
    fail "a step after the last one was not refused: $refused"
fi
expect "Step, after the last" "$refused" '(FailedPrecondition|FAILED_PRECONDITION)'
answer=$(call DeleteEnvironment "{$environment}")
expect DeleteEnvironment "$answer" "\"environmentId\":\"$session\""

echo "smoke: ok: policy $policy ran three slots at $address"
