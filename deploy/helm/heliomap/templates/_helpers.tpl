{{- define "heliomap.name" -}}
{{- if contains .Chart.Name .Release.Name }}{{ .Release.Name | trunc 50 | trimSuffix "-" }}
{{- else }}{{ printf "%s-%s" .Release.Name .Chart.Name | trunc 50 | trimSuffix "-" }}{{ end -}}
{{- end }}

{{/* The labels that select the pods of one part of this release; they must never change. */}}
{{- define "heliomap.selector" -}}
app.kubernetes.io/name: {{ .root.Chart.Name }}
app.kubernetes.io/instance: {{ .root.Release.Name }}
app.kubernetes.io/component: {{ .component }}
{{- end }}

{{- define "heliomap.labels" -}}
{{ include "heliomap.selector" . }}
app.kubernetes.io/version: {{ .root.Chart.AppVersion | quote }}
app.kubernetes.io/managed-by: {{ .root.Release.Service }}
helm.sh/chart: {{ printf "%s-%s" .root.Chart.Name .root.Chart.Version }}
{{- end }}

{{- define "heliomap.annotations" -}}
{{- if .root.Values.metrics.scrapeAnnotations }}
prometheus.io/scrape: "true"
prometheus.io/port: {{ .root.Values.metrics.port | quote }}
prometheus.io/path: /metrics
{{- end }}
{{- end }}

{{- define "heliomap.podSecurity" -}}
runAsNonRoot: true
runAsUser: 10001
runAsGroup: 10001
fsGroup: 10001
seccompProfile:
  type: RuntimeDefault
{{- end }}

{{- define "heliomap.containerSecurity" -}}
allowPrivilegeEscalation: false
readOnlyRootFilesystem: true
capabilities:
  drop: [ALL]
{{- end }}

{{/* Settings of servers and workers; secrets by reference alone. */}}
{{- define "heliomap.environment" -}}
{{- $values := .root.Values -}}
- name: HELIOMAP_DATABASE
  valueFrom:
    secretKeyRef:
      name: {{ $values.database.existingSecret }}
      key: {{ $values.database.key }}
- name: HELIOMAP_BLOBS
  value: {{ $values.blobs.url | quote }}
- name: HELIOMAP_METRICS_LISTEN
  value: "0.0.0.0:{{ $values.metrics.port }}"
- name: AWS_REGION
  value: {{ $values.blobs.region | quote }}
{{- with $values.blobs.endpoint }}
- name: AWS_ENDPOINT_URL
  value: {{ . | quote }}
{{- end }}
{{- with $values.blobs.existingSecret }}
{{- range list "AWS_ACCESS_KEY_ID" "AWS_SECRET_ACCESS_KEY" }}
- name: {{ . }}
  valueFrom:
    secretKeyRef:
      name: {{ $values.blobs.existingSecret }}
      key: {{ . }}
{{- end }}
{{- end }}
{{- range $name, $value := merge (dict) .own $values.env (.defaults | default dict) }}
- name: {{ $name }}
  value: {{ $value | quote }}
{{- end }}
{{- end }}

{{/* The label matchers that select the metrics of this release's pods in Prometheus. */}}
{{- define "heliomap.pods" -}}
{{- $name := include "heliomap.name" . -}}
{{- $pods := printf "namespace=\"%s\",pod=~\"%s-(server-[0-9]+|worker-[0-9a-z]+-[0-9a-z]+)\"" .Release.Namespace $name -}}
{{ .Values.autoscaling.matchers | default $pods }}
{{- end }}

{{/* The environment of servers only: whether clients' addresses come from a proxy. */}}
{{- define "heliomap.behindProxy" -}}
{{- if kindIs "bool" .Values.server.behindProxy }}{{ .Values.server.behindProxy }}{{ else }}{{ .Values.ingress.enabled }}{{ end }}
{{- end }}

{{- define "heliomap.image" -}}
{{ .Values.image.repository }}:{{ .Values.image.tag | default .Chart.AppVersion }}
{{- end }}
