#!/usr/bin/env bash
# Sets up a real Slurm on this one machine, to try or test launch=slurm. Debian or Ubuntu, as root; no systemd needed.
#
#   scripts/slurm_one_node.sh start     install what is missing, write /etc/slurm/slurm.conf, start the daemons
#   scripts/slurm_one_node.sh stop      end these daemons
#
# Not for a cluster: everything runs as root, and there is no accounting. It refuses to touch a Slurm that it did not set up.
set -euo pipefail

MARK="# written by gsbench's scripts/slurm_one_node.sh"
CONF=/etc/slurm/slurm.conf
PACKAGES=(slurmctld slurmd slurm-client munge)

die() {
  echo "slurm_one_node: $*" >&2
  exit 1
}

start() {
  [ "$(id -u)" = 0 ] || die "needs root"
  [ ! -e "$CONF" ] || grep -qF "$MARK" "$CONF" || die "$CONF exists and is not ours: a Slurm is set up here already"
  if ! command -v slurmctld >/dev/null || ! command -v slurmd >/dev/null || ! command -v munged >/dev/null; then
    command -v apt-get >/dev/null || die "needs apt-get to install ${PACKAGES[*]}"
    DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "${PACKAGES[@]}" >/dev/null ||
      { apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "${PACKAGES[@]}" >/dev/null; } ||
      die "could not install ${PACKAGES[*]}"
  fi
  local host cores
  host=$(hostname -s)
  cores=$(nproc)
  mkdir -p /etc/slurm /var/lib/slurm/slurmctld /var/lib/slurm/slurmd /var/log/slurm /run/munge
  chown munge: /run/munge
  # cred_expire: the seconds that a requeued job waits before it may start again (Slurm's default is 120).
  cat >"$CONF" <<EOF
$MARK
ClusterName=gsbench
SlurmctldHost=$host(127.0.0.1)
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
AuthInfo=cred_expire=10
StateSaveLocation=/var/lib/slurm/slurmctld
SlurmdSpoolDir=/var/lib/slurm/slurmd
SlurmctldLogFile=/var/log/slurm/slurmctld.log
SlurmdLogFile=/var/log/slurm/slurmd.log
SlurmctldPidFile=/run/slurmctld.pid
SlurmdPidFile=/run/slurmd.pid
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
SchedulerParameters=batch_sched_delay=1,sched_interval=5,bf_interval=5
MpiDefault=none
ReturnToService=2
JobRequeue=1
KillWait=10
AccountingStorageType=accounting_storage/none
NodeName=$host NodeAddr=127.0.0.1 CPUs=$cores State=UNKNOWN
PartitionName=debug Nodes=ALL Default=YES MaxTime=INFINITE State=UP
EOF
  pgrep -x munged >/dev/null || runuser -u munge -- /usr/sbin/munged
  pgrep -x slurmctld >/dev/null || slurmctld -c
  pgrep -x slurmd >/dev/null || slurmd
  for _ in $(seq 30); do
    if timeout 10 srun -n1 true 2>/dev/null; then
      sinfo
      return
    fi
    sleep 1
  done
  tail -5 /var/log/slurm/slurmctld.log /var/log/slurm/slurmd.log >&2 || true
  die "the daemons started, but no job ran; their logs are in /var/log/slurm"
}

stop() {
  local pids="" file
  grep -qsF "$MARK" "$CONF" || die "this Slurm was not set up by this script"
  for file in /run/slurmd.pid /run/slurmctld.pid /run/munge/munged.pid; do
    [ ! -s "$file" ] || pids="$pids $(cat "$file")"
  done
  for pid in $pids; do kill "$pid" 2>/dev/null || true; done
  for pid in $pids; do
    for _ in $(seq 100); do
      kill -0 "$pid" 2>/dev/null || break
      sleep 0.1
    done
  done
}

case "${1:-}" in
  start) start ;;
  stop) stop ;;
  *) die "say start or stop" ;;
esac
